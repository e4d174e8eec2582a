"""Smoothing removes noise, and keeps shape, attributes and coordinates far from the origin."""

from __future__ import annotations

import numpy as np
import pytest
from analytic_clouds import thin_shell, torus
from made_shapes import sphere

from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.ingest import prepare
from gnrecon.ingest.smooth import smooth_points
from gnrecon.runtime.errors import UsageError

UTM = np.array([431234.125, 5412345.5, 312.0])


def off_torus(points: np.ndarray, tube: float = 0.3) -> np.ndarray:
    return np.hypot(np.hypot(points[:, 0], points[:, 1]) - 1, points[:, 2]) - tube


@pytest.mark.parametrize("count", [3000, 20_000])
def test_noise_goes_and_curvature_stays(count: int, rng: np.random.Generator) -> None:
    points, normals = torus(count, rng)
    noisy = points + 0.01 * rng.normal(size=(count, 1)) * normals
    moved, turned = smooth_points(noisy, normals, 0.15)
    assert np.sqrt((off_torus(moved) ** 2).mean()) < (0.0075 if count < 10_000 else 0.0035)
    assert abs(off_torus(moved).mean()) < 0.001
    assert np.einsum("ij,ij->i", turned, normals).mean() > (0.98 if count < 10_000 else 0.99)
    np.testing.assert_allclose(np.linalg.norm(turned, axis=1), 1)


def test_a_clean_cloud_hardly_moves(rng: np.random.Generator) -> None:
    points, normals = sphere(5000, rng)
    moved, turned = smooth_points(points, normals, 0.2)
    assert np.linalg.norm(moved - points, axis=1).max() < 2e-4
    assert np.einsum("ij,ij->i", turned, normals).min() > 0.9999


@pytest.mark.seed(2311571107)
def test_each_point_is_where_the_weighted_quadric_says(rng: np.random.Generator) -> None:
    points, normals = sphere(400, rng)
    noisy = points * (1 + 0.02 * rng.normal(size=(400, 1)))
    moved, turned = smooth_points(noisy, normals, 0.4)
    for row in range(0, 400, 40):
        near = np.flatnonzero((np.linalg.norm(noisy - noisy[row], axis=1) < 0.4) & (normals @ normals[row] > 0))
        if len(near) < 9:  # too few for a quadric
            np.testing.assert_array_equal(moved[row], noisy[row])
            continue
        weights = (1 - (np.linalg.norm(noisy[near] - noisy[row], axis=1) / 0.4) ** 2) ** 4
        axis = weights @ normals[near]
        axis /= np.linalg.norm(axis)
        across = np.linalg.svd(axis[None])[2][1:]
        u, v = across @ (noisy[near] - noisy[row]).T
        columns = np.column_stack([np.ones_like(u), u, v, u * u, u * v, v * v])
        root = np.sqrt(weights)
        heights = (noisy[near] - noisy[row]) @ axis
        quadric = np.linalg.lstsq(columns * root[:, None], heights * root, rcond=None)[0]
        np.testing.assert_allclose(moved[row], noisy[row] + quadric[0] * axis, atol=1e-6)
        slope = axis - quadric[1:3] @ across
        np.testing.assert_allclose(turned[row], slope / np.linalg.norm(slope), atol=1e-5)


def test_the_sides_of_a_thin_wall_do_not_meet(rng: np.random.Generator) -> None:
    points, normals = thin_shell(8000, rng, wall=0.1)
    moved, _ = smooth_points(points, normals, 0.2)
    inner = np.linalg.norm(points, axis=1) < 0.95
    away = points[:, 2] < 0.1  # from the rim
    np.testing.assert_allclose(np.linalg.norm(moved[inner & away], axis=1), 0.9, atol=3e-3)
    np.testing.assert_allclose(np.linalg.norm(moved[~inner & away], axis=1), 1.0, atol=3e-3)


def test_lonely_points_stay(rng: np.random.Generator) -> None:
    points, normals = sphere(2000, rng)
    far = np.vstack([points, [[5.0, 0, 0]]])
    moved, turned = smooth_points(far, np.vstack([normals, [[0.0, 0.6, 0.8]]]), 0.2)
    np.testing.assert_array_equal(moved[-1], far[-1])
    np.testing.assert_array_equal(turned[-1], [0, 0.6, 0.8])


def test_samples_are_smoothed_and_it_is_told(rng: np.random.Generator) -> None:
    points, normals = torus(4000, rng)
    noisy = PointCloud(10 * (points + 0.01 * rng.normal(size=(4000, 1)) * normals) + UTM, normals)
    samples, counts = prepare(noisy, smooth_scan="6s", units="mm", holdout=0.1)
    local = (samples.frame.to_world(samples.points) - UTM) / 10
    assert np.sqrt((off_torus(local) ** 2).mean()) < 0.006
    assert counts.moved == pytest.approx(0.1, rel=0.3)
    assert "Smoothed the points; they moved by 0.0" in " ".join(counts.remarks())
    assert samples.held_out is not None
    kept_out = (samples.held_out.frame.to_world(samples.held_out.points) - UTM) / 10
    assert np.sqrt((off_torus(kept_out) ** 2).mean()) == pytest.approx(
        0.01, rel=0.15
    )  # validation points are not smoothed
    assert prepare(noisy)[1].moved is None
    with pytest.raises(UsageError, match="is not a positive distance"):
        prepare(noisy, smooth_scan=0)
