"""The default fit: known shapes, with and without noise, and what it chose."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree

from gnrecon.export import curvatures
from gnrecon.field.partition_of_unity import Detail
from gnrecon.field.random_features import Features
from gnrecon.fit import FitOptions, NeuralSDF, Uncertainty, fit, local_fields
from gnrecon.fit import two_level as adaptive
from gnrecon.fit.blocks.block_parameters import BlockParameters
from gnrecon.fit.blocks.solve import solve_by_blocks
from gnrecon.fit.global_field import FieldResiduals
from gnrecon.fit.model_selection import Hyperparameters, _smoothest, select_hyperparameters
from gnrecon.fit.parameters import ModelSelectionParameters, SurfaceLikelihoodParameters
from gnrecon.geometry.point_cloud import Frame, Samples
from gnrecon.runtime.errors import InputError

FRAME = Frame(np.array([10.0, -20.0, 30.0]), 2.0)


def torus(count: int, rng: np.random.Generator, noise: float = 0.0) -> Samples:
    """Uniform points of the torus of radii 0.7 and 0.25, in unit coordinates, moved along their normals."""
    u = rng.uniform(0, 2 * np.pi, 4 * count)
    v = rng.uniform(0, 2 * np.pi, 4 * count)
    kept = np.flatnonzero(rng.uniform(0, 0.95, 4 * count) < 0.7 + 0.25 * np.cos(v))[:count]
    u, v = u[kept], v[kept]
    normals = np.stack([np.cos(u) * np.cos(v), np.sin(u) * np.cos(v), np.sin(v)], axis=1)
    ring = 0.7 * np.stack([np.cos(u), np.sin(u), 0 * u], axis=1)
    return Samples(ring + (0.25 + noise * rng.standard_normal(count))[:, None] * normals, normals, FRAME)


def distance(samples: Samples) -> np.ndarray:
    x = samples.points
    return np.hypot(np.hypot(x[:, 0], x[:, 1]) - 0.7, x[:, 2]) - 0.25


def rippled(count: int, rng: np.random.Generator) -> Samples:
    """Points of a sphere with ripples that a smooth field cannot follow: |x| = 0.8 + 0.02 sin 14x sin 14y."""

    def level(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        radius, (sx, sy), (cx, cy) = np.linalg.norm(x, axis=1), np.sin(14 * x[:, :2]).T, np.cos(14 * x[:, :2]).T
        gradient = x / radius[:, None] - 0.28 * np.stack([cx * sy, sx * cy, 0 * sx], axis=1)
        return radius - 0.8 - 0.02 * sx * sy, gradient

    x = rng.standard_normal((count, 3))
    x *= 0.8 / np.linalg.norm(x, axis=1, keepdims=True)
    for _ in range(20):
        value, gradient = level(x)
        x -= (value / np.einsum("ij,ij->i", gradient, gradient))[:, None] * gradient
    gradient = level(x)[1]
    return Samples(x, gradient / np.linalg.norm(gradient, axis=1, keepdims=True), FRAME)


@pytest.fixture(scope="module")
def clean() -> tuple[Samples, NeuralSDF]:
    samples = rippled(2500, np.random.default_rng(5))
    return samples, fit(samples, FitOptions(quality="draft"))[0]


def test_a_clean_scan_is_interpolated(clean: tuple[Samples, NeuralSDF]) -> None:
    sdf = clean[1]
    assert sdf.detail is not None
    unseen = rippled(2000, np.random.default_rng(6))
    world = FRAME.to_world(unseen.points)
    assert np.abs(sdf.sdf(world)).mean() / FRAME.scale < 1e-3
    assert np.abs(sdf.sdf(world)).mean() < 0.2 * np.abs(sdf.coarse().sdf(world)).mean()
    assert np.einsum("ij,ij->i", sdf.normals(world), unseen.normals).mean() > 0.995


def test_what_a_smooth_field_explains_is_no_noise() -> None:
    samples = torus(1500, np.random.default_rng(5))
    sdf, solution = fit(samples, FitOptions(quality="draft"))
    assert sdf.detail is not None
    assert sdf.detail.position < 1e-3
    assert np.abs(sdf.sdf(FRAME.to_world(torus(2000, np.random.default_rng(6)).points))).mean() / FRAME.scale < 2e-4
    assert "by linear least squares" in solution.status


def test_noise_is_seen_and_smoothed() -> None:
    rng = np.random.default_rng(7)
    noisy = torus(1500, rng, noise=0.01)
    sdf, solution = fit(noisy, FitOptions(quality="draft"))
    assert sdf.detail is not None
    assert 0.002 < sdf.detail.position < 0.05
    unseen = FRAME.to_world(torus(2000, rng).points)
    assert np.abs(sdf.sdf(unseen)).mean() / FRAME.scale < 0.6 * 0.01 * np.sqrt(2 / np.pi)
    assert "noise" in solution.status


def test_ten_points_are_enough() -> None:
    directions = np.random.default_rng(0).standard_normal((10, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    sdf, _ = fit(Samples(0.8 * directions, directions, FRAME), FitOptions(quality="draft"))
    assert np.sqrt(np.mean(sdf.sdf(sdf.data) ** 2)) < 0.1 * FRAME.scale


@pytest.mark.parametrize("farther", [1.0, 30.0])
def test_corners_of_a_cube_far_from_each_other_are_fitted(farther: float) -> None:
    """No place of the box has a known distance, or no cube of the local fields two points."""
    corners = np.stack(np.meshgrid(*3 * [[-0.5, 0.5]]), axis=-1).reshape(-1, 3)
    corners[-1] *= farther
    corners /= np.abs(corners).max() * np.sqrt(3)
    directions = corners / np.linalg.norm(corners, axis=1, keepdims=True)
    sdf, _ = fit(Samples(corners, directions, FRAME), FitOptions(quality="draft"))
    assert np.isfinite(sdf.sdf(sdf.data)).all()
    assert sdf.detail is not None
    assert len(sdf.detail) > 0


def with_gap(samples: Samples, *, radius: float = 0.25) -> tuple[Samples, Samples]:
    """A scan of the rippled sphere without the points about one place, and those points."""
    off = np.linalg.norm(samples.points - [0.0, 0.0, 0.8], axis=1) < radius
    parts = [(samples.points[rows], samples.normals[rows]) for rows in (~off, off)]
    return Samples(*parts[0], FRAME), Samples(*parts[1], FRAME)


def bending(sdf: NeuralSDF, about: Samples) -> float:
    """Mean curvature over that of the sphere, root mean square at the field's own surface about some points."""
    x = FRAME.to_world(about.points)
    for _ in range(10):
        value, gradient = sdf.sdf_and_gradient(x)
        x = x - (value / (gradient**2).sum(axis=1))[:, None] * gradient
    mean = curvatures(sdf.gradient(x), sdf.hessian(x))[0]
    return float(np.sqrt(np.mean((mean * FRAME.scale * 0.8) ** 2)))


def test_a_gap_of_a_clean_scan_is_bridged_by_coarser_fields(monkeypatch: pytest.MonkeyPatch) -> None:
    scan, unseen = with_gap(rippled(12_000, np.random.default_rng(5)))  # the gap is six length scales wide
    bridged = fit(scan, FitOptions(quality="draft"))[0]
    assert bridged.detail is not None
    assert bridged.detail.coarser is not None
    assert np.median(bridged.detail.coarser.lengths) > 2 * np.median(bridged.detail.lengths)
    monkeypatch.setattr(local_fields, "_coarser_levels", lambda *_: 0)
    plain = fit(scan, FitOptions(quality="draft"))[0]
    x = FRAME.to_world(unseen.points)
    assert np.abs(bridged.sdf(x)).mean() < 0.8 * np.abs(plain.sdf(x)).mean()
    assert bending(bridged, unseen) < bending(plain, unseen)


@pytest.mark.parametrize(("noise", "gap"), [(0.0, False), (0.004, True)], ids=["closed", "noisy"])
def test_other_scans_get_no_coarser_fields(noise: float, gap: bool, rng: np.random.Generator) -> None:
    scan = rippled(2500, rng)
    scan = with_gap(scan)[0] if gap else scan
    moved = scan.points + noise * rng.standard_normal((len(scan), 1)) * scan.normals
    sdf, _ = fit(Samples(moved, scan.normals, FRAME), FitOptions(quality="draft"))
    assert sdf.detail is not None
    assert sdf.detail.coarser is None


@pytest.mark.parametrize(
    ("far", "noise", "levels"),
    [(0.5, 1e-4, 0), (1.5, 1e-4, 1), (2.9, 1e-4, 1), (5.0, 1e-4, 2), (1e3, 1e-4, 2), (5.0, 0.02, 0)],
)
def test_fields_that_are_lengths_off_their_points_are_corrected_by_coarser_ones_first(
    clean: tuple[Samples, NeuralSDF], far: float, noise: float, levels: int, rng: np.random.Generator
) -> None:
    samples, length = clean[0], 0.02
    value = length * np.where(rng.random(len(samples)) < 0.02, far, 0.1)
    residuals = FieldResiduals(samples.points, samples.normals, value, samples.normals)
    belief = Hyperparameters(length, noise, 0.05)
    # Those of the longest length are no longer than a quarter of the scan: 0.18.
    assert local_fields._coarser_levels(residuals, belief, rng) == levels
    one_far = replace(residuals, value=np.where(np.arange(len(value)), 0.1 * length, far * length))
    assert local_fields._coarser_levels(one_far, belief, rng) == 0


def test_processes_solve_the_local_fields_of_many_points(
    clean: tuple[Samples, NeuralSDF], monkeypatch: pytest.MonkeyPatch
) -> None:
    samples, here = clean
    solved: list[int] = []

    def counted(*given: Any, **named: Any) -> Detail:
        solved.append(len(given[1]))
        return solve_by_blocks(*given, **named)

    monkeypatch.setattr(adaptive, "solve_by_blocks", counted)
    monkeypatch.setattr(BlockParameters, "process_points", len(samples))
    elsewhere, _ = fit(samples, FitOptions(quality="draft"))
    assert solved == [len(samples)]
    assert elsewhere.detail is not None
    assert here.detail is not None
    np.testing.assert_array_equal(elsewhere.detail.keys, here.detail.keys)
    x = FRAME.to_world(samples.points)
    np.testing.assert_allclose(elsewhere.sdf(x), here.sdf(x), atol=1e-6)
    assert fit(samples, FitOptions(quality="draft", smooth="strain=1e-4"))[0].detail is not None
    assert len(solved) == 1  # those under penalties are solved here


def test_processes_know_coarser_fields(clean: tuple[Samples, NeuralSDF], monkeypatch: pytest.MonkeyPatch) -> None:
    samples = with_gap(clean[0])[0]
    monkeypatch.setattr(local_fields, "_coarser_levels", lambda *_: 2)
    here, _ = fit(samples, FitOptions(quality="draft"))
    monkeypatch.setattr(BlockParameters, "process_points", len(samples))
    elsewhere, _ = fit(samples, FitOptions(quality="draft"))
    assert here.detail is not None
    assert elsewhere.detail is not None
    lengths = [[float(np.median(level.lengths)) for level in sdf.detail.levels] for sdf in (here, elsewhere)]  # type: ignore[union-attr]
    assert lengths[0] == lengths[1]
    np.testing.assert_allclose(np.array(lengths[0])[1:] / lengths[0][0], [3.0, 9.0], rtol=0.2)
    x = FRAME.to_world(samples.points + 0.02 * samples.normals)
    np.testing.assert_allclose(elsewhere.sdf(x), here.sdf(x), atol=1e-5)


def test_equal_seeds_give_equal_fields(clean: tuple[Samples, NeuralSDF]) -> None:
    samples = clean[0]
    few = Samples(samples.points[::4], samples.normals[::4], FRAME)
    one, other = (fit(few, FitOptions(quality="draft"))[0] for _ in range(2))
    x = FRAME.to_world(samples.points)
    assert one.detail is not None
    np.testing.assert_array_equal(one.sdf(x), other.sdf(x))


def test_a_field_with_detail_is_saved_and_read(clean: tuple[Samples, NeuralSDF], tmp_path: Path) -> None:
    samples, sdf = clean
    path = tmp_path / "torus.gnr"
    sdf.save(path)
    read = NeuralSDF.load(path)
    x = FRAME.to_world(samples.points + 0.01)
    np.testing.assert_array_equal(read.sdf(x), sdf.sdf(x))
    np.testing.assert_array_equal(read.hessian(x[:9]), sdf.hessian(x[:9]))
    assert read.parameters == sdf.parameters > 10_000
    assert read.detail is not None
    assert read.detail.as_dict(1.0) == sdf.detail.as_dict(1.0)  # type: ignore[union-attr]


def test_a_field_with_coarser_detail_is_saved_and_read(clean: tuple[Samples, NeuralSDF], tmp_path: Path) -> None:
    samples, sdf = clean
    detail = sdf.detail
    assert detail is not None
    features = Features(2 * detail.features.frequencies, 1 + detail.features.phases)
    changed = {"keys": detail.keys + 1, "lengths": 3 * detail.lengths, "amplitudes": 2 * detail.amplitudes}
    coarser = replace(detail, features=features, **changed)
    others = Features(3 * detail.features.frequencies, 2 + detail.features.phases)
    changed = {"keys": detail.keys - 1, "lengths": 9 * detail.lengths, "amplitudes": 3 * detail.amplitudes}
    coarsest = replace(detail, features=others, **changed)
    two = replace(sdf, detail=replace(detail, coarser=coarser))
    three = replace(sdf, detail=replace(detail, coarser=replace(coarser, coarser=coarsest)))
    x, path = FRAME.to_world(samples.points + 0.01), tmp_path / "levels.gnr"
    for levels, (one, fewer) in enumerate(((two, sdf), (three, two)), 2):
        one.save(path, overwrite=True)
        again = NeuralSDF.load(path)
        np.testing.assert_array_equal(again.sdf(x), one.sdf(x))
        assert np.abs(one.sdf(x) - fewer.sdf(x)).max() > 1e-6
        assert again.parameters == one.parameters == levels * (sdf.parameters - len(sdf.theta)) + len(sdf.theta)


def test_a_detail_that_does_not_fit_together_is_refused(clean: tuple[Samples, NeuralSDF], tmp_path: Path) -> None:
    from safetensors.torch import load_file, save_file

    path = tmp_path / "torus.gnr"
    clean[1].save(path)
    tensors = load_file(path)
    from safetensors import safe_open

    with safe_open(str(path), framework="pt") as file:
        metadata = file.metadata()
    save_file({**tensors, "detail.lengths": tensors["detail.lengths"][1:].clone()}, path, metadata)
    with pytest.raises(InputError, match="do not fit together"):
        NeuralSDF.load(path)
    save_file({**tensors, "detail.lengths": -tensors["detail.lengths"]}, path, metadata)
    with pytest.raises(InputError, match="not positive"):
        NeuralSDF.load(path)


def test_derivatives_of_the_whole_field(clean: tuple[Samples, NeuralSDF]) -> None:
    samples, sdf = clean
    x, h = FRAME.to_world(1.05 * samples.points[:40]), 1e-4
    value, gradient = sdf.sdf_and_gradient(x)
    np.testing.assert_allclose(value, sdf.sdf(x), rtol=1e-12, atol=1e-13)
    slopes = [(sdf.sdf(x + step) - sdf.sdf(x - step)) / (2 * h) for step in h * np.eye(3)]
    np.testing.assert_allclose(gradient, np.stack(slopes, axis=1), atol=1e-5)
    bends = [(sdf.gradient(x + step) - sdf.gradient(x - step)) / (2 * h) for step in h * np.eye(3)]
    np.testing.assert_allclose(sdf.hessian(x), np.stack(bends, axis=2), atol=1e-3)


def test_uncertainty_grows_where_there_is_no_data() -> None:
    samples = torus(1000, np.random.default_rng(5))
    hole = np.linalg.norm(samples.points - [0.7, 0.0, 0.25], axis=1) < 0.1
    holed = Samples(samples.points[~hole], samples.normals[~hole], FRAME)
    sdf = fit(holed, FitOptions(quality="draft"))[0]
    found = Uncertainty.of(sdf, holed)
    inside, outside = (found.sigma(FRAME.to_world(samples.points[rows][:200])) for rows in (hole, ~hole))
    assert np.median(inside) > 2 * np.median(outside)
    errors = np.abs(sdf.sdf(FRAME.to_world(samples.points[hole])))[:200]
    assert np.median(errors) < 3 * np.median(inside)
    assert found.factor >= 1.0


def test_the_score_does_not_reward_a_flat_field() -> None:
    """Noisy points closer than they are exact: a field that is zero around all of them has no residuals."""
    rng = np.random.default_rng(8)
    noisy = torus(2500, rng, noise=0.02)
    zero = np.zeros(len(noisy))
    held = rng.random(len(noisy)) < 0.15
    residuals = FieldResiduals(noisy.points, noisy.normals, zero + distance(noisy), noisy.normals)
    hyperparameters = select_hyperparameters(residuals, held, 0.02, rng)
    assert hyperparameters.position >= 0.005


def test_estimated_normals_do_not_smooth_ripples_away() -> None:
    """Estimated normals are means of their neighbours'; a choice that heeds them takes ripples for noise."""
    rng = np.random.default_rng(5)
    samples = rippled(2500, rng)
    near = cKDTree(samples.points).query(samples.points, 80)[1]
    normals = samples.normals[near].mean(axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    radius = np.linalg.norm(samples.points, axis=1)
    smooth = radius - 0.8, samples.points / radius[:, None]
    held = rng.random(len(samples)) < 0.15
    heeding, free = (
        select_hyperparameters(
            FieldResiduals(samples.points, normals, *smooth, estimated), held, 0.03, np.random.default_rng(1)
        )
        for estimated in (False, True)
    )
    assert free.angle > heeding.angle or free.position < heeding.position
    # The points are believed, and the normals are not.
    assert free.angle == SurfaceLikelihoodParameters.angle_radians
    assert free.position <= min(ModelSelectionParameters.position_noises_disk_radii) * 0.03


def test_scans_that_do_not_match_are_not_wound_through() -> None:
    """Two layers of a ball, with normals that were estimated: a field through all points is steep everywhere."""
    rng = np.random.default_rng(6)
    x = rng.standard_normal((2500, 3))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    apart = np.where(rng.random(2500) < 0.5, 0.006, -0.006)
    normals = x + 0.1 * rng.standard_normal(x.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    held = rng.random(2500) < 0.15
    residuals = FieldResiduals((0.8 + apart)[:, None] * x, normals, apart, x, estimated=True)
    assert select_hyperparameters(residuals, held, 0.03, rng).position > 0.002


def test_of_beliefs_that_predict_alike_the_noisier_wins() -> None:
    rng = np.random.default_rng(9)
    alike = 1.0 + 0.001 * rng.standard_normal((10, 12))
    assert _smoothest({2: alike, 3: alike}) == (3, 11)
    better = alike.copy()
    better[:, 4] -= 0.5
    assert _smoothest({2: alike, 3: better}) == (3, 4)
    assert len(ModelSelectionParameters.lengths_disk_radii) > 3


def test_left_over_is_in_unit_coordinates(clean: tuple[Samples, NeuralSDF]) -> None:
    samples, sdf = clean
    residuals = FieldResiduals.of(sdf.coarse(), samples)
    np.testing.assert_allclose(residuals.value * FRAME.scale, sdf.coarse().sdf(FRAME.to_world(samples.points)))


def test_what_one_network_must_do_is_left_to_one() -> None:
    assert FitOptions().adaptive
    for other in ({"widths": (9,)}, {"steps": 3}, {"optimiser": "adam"}, {"normals": "cosine"}):
        assert not FitOptions(**other).adaptive  # type: ignore[arg-type]


@pytest.mark.parametrize(("given", "said"), [({}, False), ({"solver": "qr"}, True), ({"search": "line"}, True)])
def test_options_of_one_network_that_were_not_used_are_named(given: dict[str, str], said: bool) -> None:
    _, solution = fit(torus(60, np.random.default_rng(0)), FitOptions(quality="draft", **given))  # type: ignore[arg-type]
    assert ("were not used" in solution.status) == said


def test_an_interrupt_leaves_the_global_field(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*args: object, **options: object) -> None:
        del args, options
        raise KeyboardInterrupt

    monkeypatch.setattr(adaptive, "fit_detail", interrupted)
    sdf, solution = fit(torus(600, np.random.default_rng(5)), FitOptions(quality="draft"))
    assert solution.interrupted
    assert sdf.detail is None
    assert "Interrupted" in solution.status


def test_points_near_the_surface_but_off_it_are_left_out() -> None:
    rng = np.random.default_rng(5)
    clean = torus(1200, rng)
    points = clean.points.copy()
    points[:12] += rng.choice([-0.1, 0.1], (12, 1)) * clean.normals[:12]
    sdf, solution = fit(Samples(points, clean.normals, FRAME), FitOptions())
    assert "Left out 12 outliers." in solution.status
    truth = torus(500, np.random.default_rng(6))
    assert np.abs(sdf.sdf(FRAME.to_world(truth.points))).mean() < 1e-3 * FRAME.scale


def test_free_space_keeps_its_sign_where_normals_would_spoil_it() -> None:
    """Of a shape with more detail than the global field can hold, exact normals may not weigh as much as they would."""
    rng = np.random.default_rng(7)
    x = rng.uniform(-1, 1, (60_000, 3))
    waves = 7.0

    def gyroid(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        s, c = np.sin(waves * x), np.cos(waves * x)
        turned = [1, 2, 0]
        gradient = waves * (c * c[:, turned] - s[:, [2, 0, 1]] * s)
        return (s * c[:, turned]).sum(axis=1), gradient

    x = x[np.linalg.norm(x, axis=1) < 0.9]
    value, gradient = gyroid(x)
    near = np.abs(value) < 0.1
    x, value, gradient = x[near][:2000], value[near][:2000], gradient[near][:2000]
    for _ in range(3):
        x = x - (value / np.einsum("ij,ij->i", gradient, gradient))[:, None] * gradient
        value, gradient = gyroid(x)
    normals = gradient / np.linalg.norm(gradient, axis=1, keepdims=True)
    sdf, _ = fit(Samples(x, normals, FRAME), FitOptions(quality="draft"))
    inside = rng.uniform(-0.5, 0.5, (4000, 3))
    value, gradient = gyroid(inside)
    clear = np.abs(value) > 0.3 * np.linalg.norm(gradient, axis=1) / waves
    agree = np.sign(sdf.sdf(FRAME.to_world(inside[clear]))) == np.sign(value[clear])
    assert agree.mean() > 0.98
