"""Averaging of noisy points: planes and balls stay, noise goes, edges stay sharp."""

from __future__ import annotations

from dataclasses import replace

import made_shapes
import numpy as np
import pytest

from gnrecon.fit.shape_priors.bilateral_filter import BilateralFilter
from gnrecon.fit.shape_priors.prior_parameters import BilateralParameters

WIDE = BilateralFilter(3.0, 0.4)


def ball(count: int, rng: np.random.Generator, noise: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    return made_shapes.sphere(count, rng, 0.8, noise)


def cube(count: int, rng: np.random.Generator, noise: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Points of the surface of [-1, 1]^3, moved along their normals."""
    return made_shapes.cube(count, 1.0, rng, noise)


def tilted(normals: np.ndarray, angle: float, rng: np.random.Generator) -> np.ndarray:
    found = normals + angle * rng.standard_normal(normals.shape)
    return found / np.linalg.norm(found, axis=1, keepdims=True)


def off_cube(x: np.ndarray) -> np.ndarray:
    outside = np.abs(x) - 1
    return np.abs(np.linalg.norm(np.maximum(outside, 0), axis=1) + np.minimum(outside.max(axis=1), 0))


def test_points_of_a_plane_stay() -> None:
    rng = np.random.default_rng(0)
    x = np.concatenate([rng.uniform(-1, 1, (500, 2)), np.full((500, 1), 0.3)], axis=1)
    normals = np.tile([0.0, 0.0, 1.0], (500, 1))
    points, found = WIDE.apply(x, normals)
    np.testing.assert_allclose(points, x, atol=1e-14)
    np.testing.assert_allclose(found, normals, atol=1e-14)


def test_a_ball_neither_shrinks_nor_swells() -> None:
    """Two points of a ball with its normals: (y - x).(n + m) = 0."""
    x, normals = ball(2000, np.random.default_rng(1))
    points, found = WIDE.apply(x, normals)
    radii = np.linalg.norm(points, axis=1)
    apart = np.sqrt(4 * np.pi * 0.8**2 / 2000)
    # A mean of the neighbours within three disks would sink by a tenth of what points are apart.
    assert abs(radii.mean() - 0.8) < 0.015 * apart
    assert np.abs(radii - 0.8).max() < 0.2 * apart
    assert np.einsum("ij,ij->i", found, normals).min() > 0.99


def test_a_cube_loses_its_noise_and_keeps_its_edges() -> None:
    rng = np.random.default_rng(2)
    x, normals = cube(6000, rng, noise=0.01)
    points, found = WIDE.apply(x, tilted(normals, 0.1, rng))
    assert off_cube(points).mean() < 0.35 * off_cube(x).mean()
    assert np.einsum("ij,ij->i", found, normals).mean() > 0.998
    # Beside an edge as well, where a mean over all neighbours would round it by a tenth of its width.
    edge = np.sort(np.abs(x), axis=1)[:, 1] > 0.95
    assert 300 < edge.sum() < 1000
    assert off_cube(points[edge]).mean() < 0.5 * off_cube(x[edge]).mean()
    unguided, _ = BilateralFilter(3.0, 10.0).apply(x, normals)
    assert off_cube(unguided[edge]).mean() > 1.5 * off_cube(points[edge]).mean()


def test_the_two_sides_of_a_sheet_do_not_attract() -> None:
    rng = np.random.default_rng(3)
    count = 2000
    side = rng.choice([-1.0, 1.0], count)
    x = np.stack([*rng.uniform(-1, 1, (2, count)), 0.005 * side], axis=1)
    points, _ = WIDE.apply(x, np.stack([0 * side, 0 * side, side], axis=1))
    np.testing.assert_allclose(points, x, atol=1e-9)


def test_a_surface_behind_a_wall_that_looks_the_same_way_does_not_attract() -> None:
    """As the wall of a bore behind a thin wall: a patch of it lies behind, with the same normals."""
    rng = np.random.default_rng(6)
    front, behind, noise = 4000, 300, 0.005
    x = np.concatenate([rng.uniform(-1, 1, (front, 3)), rng.uniform(-0.25, 0.25, (behind, 3))])
    height = np.concatenate([np.zeros(front), np.full(behind, -0.06)])
    x[:, 2] = height + noise * rng.standard_normal(len(x))
    points, _ = WIDE.apply(x, np.tile([0.0, 0.0, 1.0], (len(x), 1)))
    off = np.abs(points[:, 2] - height)
    central = np.abs(x[:, :2]).max(axis=1) < 0.2
    assert off[:front][central[:front]].mean() < 0.4 * noise
    assert off[front:][central[front:]].mean() < 0.4 * noise


@pytest.mark.parametrize("count", [2, 10])
def test_few_points_are_enough(count: int) -> None:
    points, normals = WIDE.apply(*ball(count, np.random.default_rng(4)))
    assert np.isfinite(points).all()
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)


def test_opposed_normals_at_one_point_stay() -> None:
    x = np.repeat([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], 2, axis=0)
    normals = np.tile([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]], (2, 1))
    points, found = WIDE.apply(x, normals)
    assert np.isfinite(points).all()
    np.testing.assert_allclose(found, normals, atol=1e-9)


def test_the_points_of_a_chunk_do_not_matter() -> None:
    x, normals = cube(700, np.random.default_rng(5), noise=0.01)
    whole = WIDE.apply(x, normals)
    chunks = replace(WIDE, parameters=BilateralParameters(chunk_points=64))
    for one, other in zip(whole, chunks.apply(x, normals), strict=True):
        np.testing.assert_array_equal(one, other)
