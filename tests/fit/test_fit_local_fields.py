"""Local fields: each cube takes the length that its own data is most likely with."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import numpy.typing as npt
import pytest
import torch

from gnrecon.field.cube_lattice import CubeLattice
from gnrecon.field.networks import Siren
from gnrecon.field.random_features import Features
from gnrecon.fit import NeuralSDF, local_fields
from gnrecon.fit.free_space import LatticeVolume, Volume
from gnrecon.fit.global_field import FieldResiduals
from gnrecon.fit.local_fields import solve_cube
from gnrecon.fit.model_selection import Hyperparameters
from gnrecon.geometry.point_cloud import Frame, Samples
from gnrecon.geometry.signed_distance import Box

Float = npt.NDArray[np.float64]
NOISE = Hyperparameters(0.4, 0.01, 0.1, by_place=True)


class NoSpace:
    """A cube about the origin around which nothing is known of free space."""

    center, reach = np.zeros(3), 1.0

    def far(self) -> Volume:
        return Volume.none()

    def near(self, *_: float) -> LatticeVolume:
        return LatticeVolume(Volume.none(), CubeLattice(*np.zeros((2, 1, 3))), np.zeros(0, dtype=np.int64))


def sheet(wavelength: float, rng: np.random.Generator) -> FieldResiduals:
    """The plane z = 0 as a global field, and points of waves on it of this length, with noise."""
    count = 300
    x, y = rng.uniform(-1, 1, (2, count))
    wave = 2 * np.pi / wavelength
    height, slope = 0.1 * wavelength * np.sin(wave * x), 0.1 * wavelength * wave * np.cos(wave * x)
    points = np.stack([x, y, height + NOISE.position * rng.standard_normal(count)], axis=1)
    normals = np.stack([-slope, np.zeros(count), np.ones(count)], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    flat = np.tile([0.0, 0.0, 1.0], (count, 1))
    return FieldResiduals(points, normals, points[:, 2], flat)


def length_of(residuals: FieldResiduals, hyperparameters: Hyperparameters) -> float:
    features = Features.draw(400, np.random.default_rng(0), torch.zeros(0, dtype=torch.float64))
    rows = np.arange(len(residuals))
    solved = partial(solve_cube, residuals, rows, hyperparameters.length, NoSpace(), features)  # type: ignore[arg-type]
    length, amplitudes = solved(hyperparameters, "cpu")
    assert amplitudes.shape == (400,)
    return length


def test_short_waves_get_a_shorter_length_than_long_ones(rng: np.random.Generator) -> None:
    short, long = (length_of(sheet(wave, rng), NOISE) for wave in (0.6, 4.0))
    assert short < NOISE.length < long


def test_the_length_of_the_scan_is_kept_where_evidence_says_nothing(rng: np.random.Generator) -> None:
    kept = Hyperparameters(NOISE.length, NOISE.position, NOISE.angle)
    assert length_of(sheet(0.6, rng), kept) == NOISE.length


def test_a_flat_global_field_gets_its_slope_where_the_prior_leaves_room_for_it(rng: np.random.Generator) -> None:
    # A wall, half as thick as the length: the field is zero on both sides, but has a fifth of a distance's slope.
    count, half = 300, 0.1
    side = np.where(np.arange(count) % 2, 1.0, -1.0)
    points = np.column_stack([rng.uniform(-1, 1, (count, 2)), half * side])
    normals = side[:, None] * [0.0, 0.0, 1.0]
    flat = FieldResiduals(points, normals, np.zeros(count), 0.2 * normals)
    features = Features.draw(400, np.random.default_rng(0), torch.zeros(0, dtype=torch.float64))
    slopes = []
    for by_slopes in (False, True):
        belief = Hyperparameters(0.4, 0.01, 0.5, by_slopes=by_slopes)
        cube = flat, np.arange(count), belief.length, NoSpace(), features
        length, amplitudes = solve_cube(*cube, belief, "cpu")  # type: ignore[arg-type]
        phases = features.phase(torch.as_tensor(points), torch.zeros(3, dtype=torch.float64), length)
        along = (phases.cos() * features.frequencies[:, 2] / length) @ amplitudes
        slopes.append(float(np.mean(0.2 + side * along.numpy())))
    assert slopes[0] < 0.3
    assert slopes[1] == pytest.approx(1.0, abs=0.15)


def test_corrections_reach_as_far_as_the_global_field_is_off(
    monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator
) -> None:
    # A global field without any surface, and a dense scan of a ball, whose cubes are thinner than it is off.
    points = rng.standard_normal((10_000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    samples = Samples(points, points.copy(), Frame(np.zeros(3), 1.0))
    field = Siren((8,))
    theta = torch.zeros(field.layout.count, dtype=torch.float64)
    theta[-1] = 0.08
    sdf = NeuralSDF(field, theta, samples.frame, Box.around(points, 0.1))
    inside = 0.95 * points[:2000]
    right = []
    for levels in (None, 0):
        if levels is not None:
            monkeypatch.setattr(local_fields, "_coarser_levels", lambda *_: 0)
        belief = Hyperparameters(0.025, 1e-3, 0.05)
        detail = local_fields.fit_detail(
            sdf, FieldResiduals.of(sdf, samples), belief, 200, np.random.default_rng(0), "cpu"
        )
        whole = replace(sdf, detail=detail)
        assert np.abs(whole.sdf(points)).mean() < 2e-4
        right.append(float((whole.sdf(inside) < 0).mean()))
    assert right[0] > 0.99
    assert right[1] < 0.9


def test_short_lengths_have_more_features_and_long_ones_no_fewer() -> None:
    counts = [local_fields.feature_count(300, length, 0.1) for length in (0.1, 0.14, 0.2, 0.8)]
    assert counts[0] > counts[1] > counts[2] == counts[3] == 300
    # Data reaches two disks beyond a cube of 4.55 lengths: 7.4 lengths of 1.4 disks, and 6.55 of two.
    assert counts[1] == pytest.approx(300 * (7.407 / 6.55) ** 3, abs=1)
