"""Unoriented normals where neighbourhoods are hard: noise, sharp edges, thin plates; and a plain reference."""

from __future__ import annotations

import made_shapes
import numpy as np
import pytest
from analytic_clouds import torus
from made_shapes import sphere

from gnrecon.geometry.arrays import Float
from gnrecon.ingest.normals import tangent_planes, unoriented_normals


def degrees(found: Float, truth: Float) -> Float:
    """Angles between lines, of shape (N,)."""
    return np.degrees(np.arccos(np.clip(np.abs(np.einsum("ij,ij->i", found, truth)), 0, 1)))


def cube(count: int, rng: np.random.Generator) -> tuple[Float, Float]:
    return made_shapes.cube(count, 1.0, rng)


def test_planes_are_those_of_a_singular_value_decomposition(rng: np.random.Generator) -> None:
    points = torus(300, rng)[0]
    found = tangent_planes(points, 12)
    for row in range(0, 300, 17):
        near = points[np.argsort(np.linalg.norm(points - points[row], axis=1))[:12]]
        axis = np.linalg.svd(near - near.mean(axis=0))[2][2]
        assert abs(found[row] @ axis) == pytest.approx(1)


def test_smooth_and_clean_clouds(rng: np.random.Generator) -> None:
    for points, truth in (sphere(2000, rng), torus(3000, rng)):
        assert np.median(degrees(unoriented_normals(points), truth)) < 3


def test_noise_asks_more_neighbours(rng: np.random.Generator) -> None:
    points, truth = torus(6000, rng)
    noisy = points + 0.015 * rng.standard_normal(points.shape)
    adaptive, narrow = (
        degrees(found, truth).mean() for found in (unoriented_normals(noisy), tangent_planes(noisy, 12))
    )
    assert adaptive < 0.75 * narrow


def test_sharp_edges_are_not_blurred(rng: np.random.Generator) -> None:
    points, truth = cube(4000, rng)
    adaptive, plain = (degrees(found, truth) for found in (unoriented_normals(points), tangent_planes(points, 12)))
    assert (adaptive > 10).mean() < 0.4 * (plain > 10).mean()
    assert adaptive.mean() < 0.5 * plain.mean()


@pytest.mark.seed(1329029803)
def test_a_plate_as_thin_as_its_points_are_apart(rng: np.random.Generator) -> None:
    points, truth = cube(4000, rng)
    flat = np.abs(truth[:, 2]) == 1
    points = points[flat] * [1, 1, 0.015]
    adaptive, plain = (
        degrees(found, truth[flat]) for found in (unoriented_normals(points), tangent_planes(points, 12))
    )
    assert (adaptive < 10).mean() > 0.95
    assert (adaptive > 10).mean() < 0.15 * (plain > 10).mean()


@pytest.mark.parametrize("count", [4, 7, 10, 25])
def test_few_points_have_directions_of_unit_length(count: int, rng: np.random.Generator) -> None:
    found = unoriented_normals(sphere(count, rng)[0])
    assert np.allclose(np.linalg.norm(found, axis=1), 1)


def test_points_on_a_line_do_no_harm() -> None:
    points = np.column_stack([np.linspace(-1, 1, 200), np.zeros(200), np.zeros(200)])
    assert np.isfinite(unoriented_normals(points)).all()
