"""Points without normals are snapped to the primitives of a machine part, and take their normals."""

from __future__ import annotations

import numpy as np
import pytest
from made_shapes import bored_plate, cube

from gnrecon.fit.shape_priors.unoriented_snapping import snap_unoriented_points
from gnrecon.geometry.arrays import Float
from gnrecon.ingest.orientation import oriented_normals

NOISE = 0.002


def turned(normals: Float, exact: Float) -> Float:
    """Return the angles between unit normals, in degrees."""
    return np.degrees(np.arccos(np.einsum("nd,nd->n", normals, exact).clip(-1, 1)))


@pytest.mark.parametrize("seed", [0, 1])
def test_normals_beside_edges_are_those_of_their_faces(seed: int) -> None:
    exact, normals = bored_plate(2500, 0.7, 0.12, 0.15, seed)
    points = exact + NOISE * np.random.default_rng(seed).standard_normal(exact.shape)
    estimated = oriented_normals(points).normals
    found = snap_unoriented_points(points, estimated)
    assert found is not None
    assert found.on_primitive.mean() > 0.9
    assert found.primitives >= 7
    before, after = ((turned(some, normals) > 15).mean() for some in (estimated, found.normals))
    assert after < 0.4 * before
    # Across the faces the noise is gone; along them it stays.
    height = np.abs(np.einsum("nd,nd->n", found.points - exact, normals))[turned(found.normals, normals) < 15]
    assert height.mean() < 0.3 * NOISE


def test_a_thin_side_is_found_once_the_points_of_the_large_faces_are_gone() -> None:
    """All neighbourhoods of the sides hold points of the upper and lower face."""
    exact, normals = bored_plate(4000, 0.8, 0.035, 0.3, seed=2)
    points = exact + NOISE / 2 * np.random.default_rng(2).standard_normal(exact.shape)
    estimated = oriented_normals(points).normals
    side = np.abs(normals[:, 2]) < 0.5
    found = snap_unoriented_points(points, estimated)
    assert found is not None
    assert (turned(estimated, normals)[side] > 15).mean() > 0.5
    assert (turned(found.normals, normals)[side] > 15).mean() < 0.25


@pytest.mark.parametrize("noise", [0.0, 0.002, 0.01])
def test_points_of_a_round_shape_lie_on_no_such_surfaces(noise: float) -> None:
    rng = np.random.default_rng(4)
    points = rng.standard_normal((2000, 3))
    points *= [0.9, 0.7, 0.5] / np.linalg.norm(points, axis=1, keepdims=True)
    points += noise * rng.standard_normal(points.shape)
    assert snap_unoriented_points(points, oriented_normals(points).normals) is None


def test_few_points_say_nothing_where_their_neighbourhoods_are_thick() -> None:
    points, _ = cube(120, 0.6)
    points += 0.05 * np.random.default_rng(5).standard_normal(points.shape)
    assert snap_unoriented_points(points, oriented_normals(points).normals) is None
    assert snap_unoriented_points(points[:8], np.tile([0.0, 0.0, 1.0], (8, 1))) is None
