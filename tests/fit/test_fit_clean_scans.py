"""Clean scans: whose noise their neighbours tell, and what is then believed of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gnrecon.fit import FitOptions, fit, model_selection
from gnrecon.fit.free_space import Volume
from gnrecon.fit.global_field import FieldResiduals
from gnrecon.fit.marginal_likelihood import MarginalLikelihood, clean_noise, median_pair_height
from gnrecon.fit.model_selection import CrossValidation, select_hyperparameters
from gnrecon.fit.parameters import CleanScanParameters, ModelSelectionParameters
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.point_cloud import Frame, Samples
from gnrecon.geometry.signed_distance import Density

FRAME = Frame(np.array([10.0, -20.0, 30.0]), 2.0)
STEP = 1e-6


def level(x: Float) -> Float:
    """Return |x| less the radius of a bumpy ball in that direction, of shape (N,)."""
    r = np.linalg.norm(x, axis=1)
    u = x / r[:, None]
    level: Float = r - 0.7 * (1 + 0.1 * np.sin(5 * u[:, 0] + 1) * np.cos(4 * u[:, 1]) + 0.08 * np.sin(16 * u[:, 2]))
    return level


def bumpy(count: int, noise: float = 0.0, tilt: float = 0.0, seed: int = 0) -> Samples:
    rng = np.random.default_rng(seed)
    u = rng.standard_normal((count, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    x = u * (1.0 - level(u))[:, None]
    slope = [(level(x + STEP * e) - level(x - STEP * e)) / (2 * STEP) for e in np.eye(3)]
    normals = np.stack(slope, axis=1) + tilt * rng.standard_normal((count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Samples(x + noise * normals * rng.standard_normal((count, 1)), normals, FRAME)


def residuals(samples: Samples, over: float = 0.1) -> FieldResiduals:
    """Return what a field leaves over that is off by a part of the radius of a disk."""
    off = np.full(len(samples.points), over * Density(samples.points).radius)
    return FieldResiduals(samples.points, samples.normals, off, samples.normals)


def told(samples: Samples) -> tuple[Float, Float, Density]:
    return samples.points, samples.normals, Density(samples.points)


def off_truth(samples: Samples) -> float:
    """Return how far the surface is from points that were not fitted, on the mean, in radii of a scanned one's disk."""
    sdf, _ = fit(samples, FitOptions(quality="draft"))
    fresh = bumpy(2000, seed=1)
    value, gradient = sdf.sdf_and_gradient(FRAME.to_world(fresh.points))
    distance = np.abs(value) / np.einsum("nd,nd->n", gradient, fresh.normals).clip(0.2)
    return float(distance.mean() / FRAME.scale / Density(samples.points).radius)


def test_neighbours_tell_the_noise_of_positions() -> None:
    radius = Density(bumpy(1500).points).radius
    assert median_pair_height(*told(bumpy(1500))) < 0.01
    for share in (0.1, 0.2):
        # Half of the sum of two heights, each of both points' noise: its median is 0.95 of that noise, and less of
        # pairs that are more than a radius apart.
        assert median_pair_height(*told(bumpy(1500, share * radius))) == pytest.approx(0.75 * share, rel=0.2)


def test_a_clean_scan_has_the_noise_that_its_neighbours_tell() -> None:
    scan, radius = told(bumpy(1500)), Density(bumpy(1500).points).radius
    position, angle = clean_noise(*scan, radius, estimated=False) or pytest.fail("the scan is clean")
    assert CleanScanParameters.least_position_noise_disk_radii * radius <= position < 0.01 * radius
    assert CleanScanParameters.least_angle_noise_radians <= angle < 0.015
    assert clean_noise(*scan, radius, estimated=True) == (
        CleanScanParameters.least_position_noise_disk_radii * radius,
        CleanScanParameters.estimated_angle_noise_radians,
    )


@pytest.mark.parametrize(
    ("scan", "over"),
    [
        pytest.param(bumpy(1500, noise=0.003), 0.1, id="noisy points"),
        pytest.param(bumpy(1500, tilt=0.15), 0.1, id="noisy normals"),
        pytest.param(bumpy(1500), 0.005, id="nothing left over"),
        pytest.param(bumpy(8), 0.1, id="too few pairs"),
    ],
)
def test_of_other_scans_the_noise_is_chosen(scan: Samples, over: float) -> None:
    points, normals, density = told(scan)
    assert clean_noise(points, normals, density, over * density.radius, estimated=False) is None


def test_what_was_found_with_the_normals_counts_more_than_pairs() -> None:
    exact, noisy = told(bumpy(1500)), told(bumpy(1500, noise=0.003))
    radius = exact[2].radius
    assert clean_noise(*exact, radius, estimated=True, clean=False) is None
    assert clean_noise(*noisy, radius, estimated=True, clean=None) is None
    assert clean_noise(*noisy, radius, estimated=True, clean=True) == (
        CleanScanParameters.least_position_noise_disk_radii * noisy[2].radius,
        CleanScanParameters.estimated_angle_noise_radians,
    )


def test_points_that_were_scanned_twice_are_no_pairs() -> None:
    scan = bumpy(600)
    twice = replace(scan, points=np.repeat(scan.points, 2, axis=0), normals=np.repeat(scan.normals, 2, axis=0))
    assert median_pair_height(*told(twice)) == pytest.approx(median_pair_height(*told(scan)), rel=0.6)


@pytest.mark.parametrize("estimated", [False, True])
def test_the_points_themselves_show_how_fast_they_vary(estimated: bool) -> None:
    """Whichever points are left out, and with normals that are no more than estimated."""
    scan = bumpy(3000)
    radius, noise = Density(scan.points).radius, 0.1 if estimated else 0.01
    normals = scan.normals + noise * np.random.default_rng(1).standard_normal((3000, 3))
    lengths = []
    for waves in (6.0, 24.0):
        value = 0.3 * radius * np.sin(waves * scan.points[:, 0])
        slope = 0.3 * radius * waves * np.cos(waves * scan.points[:, 0])
        gradient = scan.normals + slope[:, None] * np.array([1.0, 0.0, 0.0])
        left = FieldResiduals(scan.points, scan.normals if not estimated else normals, value, gradient, estimated)
        chosen = [
            select_hyperparameters(left, np.arange(3000) % 6 == rest, radius, np.random.default_rng(0))
            for rest in (0, 1)
        ]
        assert chosen[0] == chosen[1]
        assert chosen[0].position < 0.02 * radius, "the scan is clean"
        lengths.append(chosen[0].length)
    assert lengths[0] > 1.4 * lengths[1]


@pytest.mark.parametrize(("likeliest", "predicting", "expected"), [(3, 1, 1), (1, 3, 1), (0, None, 0)])
def test_the_shorter_of_two_lengths_is_taken(
    likeliest: int, predicting: int | None, expected: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing is predicted where the likeliest is the shortest of all."""
    left, lengths = residuals(bumpy(600)), ModelSelectionParameters.lengths_disk_radii
    radius = left.density.radius
    monkeypatch.setattr(MarginalLikelihood, "likeliest_length", lambda *_: lengths[likeliest] * radius)

    def by_prediction(validation: CrossValidation) -> float:
        assert predicting is not None
        assert validation.known is not None
        return lengths[predicting] * radius

    monkeypatch.setattr(CrossValidation, "length_of_clean_scan", by_prediction)
    chosen = select_hyperparameters(left, np.arange(600) % 6 == 0, radius, np.random.default_rng(0))
    assert chosen.length == lengths[expected] * radius


def test_unsure_normals_bind_less_and_allow_a_shorter_length() -> None:
    """One in three normals is far off: known as such, it bends no field, and the others count as before."""
    scan, rng = bumpy(600), np.random.default_rng(2)
    radius = Density(scan.points).radius
    deviations = np.where(rng.random(600) < 1 / 3, 0.6, 0.03)
    normals = scan.normals + deviations[:, None] * rng.standard_normal((600, 3))
    # Half a radius apart, residuals have nothing in common.
    value = 0.05 * radius * np.sin(8.0 / radius * scan.points[:, 0])
    given = FieldResiduals(scan.points, normals, value, scan.normals, True, None, True, deviations)
    chosen = select_hyperparameters(given, np.arange(600) % 6 == 0, radius, np.random.default_rng(0))
    assert chosen.angle == pytest.approx(0.03)
    assert chosen.length == ModelSelectionParameters.short_length_disk_radii * radius
    patch = given.take(np.arange(100, 600)).patch(np.arange(50), np.zeros(3), Volume.none(), "cpu")
    assert patch.normal_weights is not None
    np.testing.assert_allclose(patch.normal_weights, (0.03 / deviations[100:150]) ** 2)
    plain = replace(given, deviations=None)
    assert plain.patch(np.arange(50), np.zeros(3), Volume.none(), "cpu").normal_weights is None
    longer = select_hyperparameters(plain, np.arange(600) % 6 == 0, radius, np.random.default_rng(0)).length
    assert longer >= ModelSelectionParameters.lengths_disk_radii[0] * radius


def test_a_longer_length_is_taken_only_where_it_is_clearly_better(monkeypatch: pytest.MonkeyPatch) -> None:
    scan = residuals(bumpy(200))
    validation = CrossValidation.draw(scan, np.arange(200) % 6 == 0, 1.0, np.random.default_rng(0), "cpu")
    even = np.linspace(-1.0, 1.0, 10)[:, None]
    lengths = ModelSelectionParameters.lengths_disk_radii
    # In one patch all lengths are far off, and which of them by more is chance.
    astray = 1000.0 * (np.arange(10) == 4)[:, None]
    scores = {
        lengths[0]: 3.0 + even + astray,
        lengths[1]: 2.0 + even + 1.1 * astray,
        lengths[2]: 1.99 - even + 1.1 * astray,
        lengths[3]: 1e-3 + 0.0 * even,
    }
    monkeypatch.setattr(CrossValidation, "scores", lambda _, length: scores[length])
    assert validation.length_of_clean_scan() == lengths[1]


def test_clean_scans_are_fitted_nearer_than_by_choice(monkeypatch: pytest.MonkeyPatch) -> None:
    scan = bumpy(800)
    by_neighbours = off_truth(scan)
    monkeypatch.setattr(model_selection, "_of_clean_scan", lambda *_: None)
    by_evidence = off_truth(scan)
    select = CrossValidation.select
    monkeypatch.setattr(CrossValidation, "select", lambda one: select(replace(one, likelihood=None)))
    by_choice = off_truth(scan)
    assert by_neighbours < min(0.7 * by_choice, 0.9 * by_evidence, 0.05), (by_neighbours, by_choice, by_evidence)
