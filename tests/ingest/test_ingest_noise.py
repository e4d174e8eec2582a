"""Noise is estimated to within a few per cent, on dense and on sparse clouds, and is zero on exact ones."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from analytic_clouds import torus
from made_shapes import sphere

from gnrecon.geometry.local_pca import tangent_coordinates
from gnrecon.ingest import estimate_noise, mean_spacing

Shape = Callable[[int, np.random.Generator], tuple[np.ndarray, np.ndarray]]
RADIUS = {sphere: 1.0, torus: 1.3}


@pytest.mark.parametrize("shape", [sphere, torus])
@pytest.mark.parametrize("count", [500, 2000, 8000, 40_000])
@pytest.mark.parametrize("share", [0.0025, 0.005, 0.01])
def test_noise_of_known_size(shape: Shape, count: int, share: float, rng: np.random.Generator) -> None:
    points, normals = shape(count, rng)
    noise = share * RADIUS[shape]
    noisy = points + noise * rng.normal(size=(count, 1)) * normals
    found = estimate_noise(noisy, mean_spacing(noisy))
    assert found.deviation == pytest.approx(noise, rel=0.3 if count == 500 else 0.2 if count == 2000 else 0.1)
    assert found.limit >= found.deviation


@pytest.mark.parametrize("shape", [sphere, torus])
@pytest.mark.parametrize("count", [500, 2000, 40_000])
def test_clean_clouds_have_none(shape: Shape, count: int, rng: np.random.Generator) -> None:
    points, _ = shape(count, rng)
    found = estimate_noise(points, mean_spacing(points))
    assert found.deviation == 0
    assert found.limit < (0.003 if count == 500 else 0.0003)


def test_noise_that_is_wide_against_the_spacing(rng: np.random.Generator) -> None:
    points, normals = sphere(60_000, rng)
    noisy = points + 0.02 * rng.normal(size=(60_000, 1)) * normals
    assert mean_spacing(noisy) < 0.02
    found = estimate_noise(noisy, mean_spacing(noisy))
    assert found.deviation == pytest.approx(0.02, rel=0.1)


def test_edges_and_outliers_count_little(rng: np.random.Generator) -> None:
    points, rows = rng.uniform(-1, 1, (8000, 3)), np.arange(8000)
    axis = rng.integers(0, 3, 8000)
    points[rows, axis] = rng.choice([-1.0, 1.0], 8000) + 0.01 * rng.normal(size=8000)
    mixed = np.vstack([points, rng.uniform(-2, 2, (240, 3))])
    found = estimate_noise(mixed, mean_spacing(mixed))
    assert found.deviation == pytest.approx(0.01, rel=0.15)


def test_too_few_points_for_their_shape_tell_nothing(rng: np.random.Generator) -> None:
    points = rng.uniform(-1, 1, (300, 3))  # no surface at all
    found = estimate_noise(points, mean_spacing(points))
    assert found.deviation is None
    assert found.limit > 0.02


def test_frames_keep_distances(rng: np.random.Generator) -> None:
    groups = rng.normal(size=(5, 9, 3))
    local = tangent_coordinates(groups)
    reach = np.linalg.norm(groups - groups[:, :1], axis=2).max(axis=1)
    np.testing.assert_allclose(
        np.linalg.norm(local, axis=2) * reach[:, None], np.linalg.norm(groups - groups[:, :1], axis=2)
    )
    spread = local.std(axis=1)
    assert (spread[:, 0] >= spread[:, 1]).all()
    assert (spread[:, 1] >= spread[:, 2]).all()
