"""The sides of open scenes by their winding number: sheets, an object above a ground, and points in strips."""

from __future__ import annotations

import numpy as np
import pytest
from made_shapes import sphere
from numpy.typing import NDArray

from gnrecon.geometry.open_scenes import WindingLevel, sheet_dipoles
from gnrecon.geometry.signed_distance import CoarseDistance, Density, scene_dipoles

Float = NDArray[np.float64]
UP = np.array([0.0, 0.0, 1.0])


def sides(points: Float, normals: Float, x: Float, *, may_be_open: bool = True) -> Float:
    coarse = CoarseDistance(points, normals, np.random.default_rng(0), may_be_open=may_be_open)
    return coarse.winding_number(x)


def plate(count: int) -> Float:
    flat = np.random.default_rng(1).uniform(-0.7, 0.7, (count, 2))
    return np.column_stack([flat, np.zeros(count)])


def strips() -> Float:
    """Points in bundles 0.006 wide and 0.12 apart, on a hilly ground."""
    rng = np.random.default_rng(2)
    across = np.repeat(np.arange(-0.6, 0.61, 0.12), 200)
    x, y = across + rng.uniform(0, 0.006, len(across)), rng.uniform(-0.6, 0.6, len(across))
    return np.column_stack([x, y, height(x, y)])


def height(x: Float, y: Float) -> Float:
    return 0.08 * np.sin(5 * x) + 0.05 * np.cos(4 * y)


def test_closed_surfaces_are_left_as_they_are() -> None:
    points, normals = sphere(2000)
    x = np.random.default_rng(1).uniform(-1.5, 1.5, (200, 3))
    np.testing.assert_array_equal(sides(points, normals, x), sides(points, normals, x, may_be_open=False))
    disks = Density(points).disks
    directions, radii = sheet_dipoles(points, normals, disks)
    assert directions is normals
    assert radii is disks
    level = WindingLevel.at_points(np.full(9, 0.3))
    assert not level.is_open
    np.testing.assert_array_equal(level.centred(x[:, 0], np.zeros(200)), x[:, 0])


def test_what_is_below_a_sheet_is_inside_and_far_below_outside() -> None:
    points = plate(2000)
    normals = np.tile(UP, (2000, 1))
    middle = points[(np.abs(points) < 0.4).all(axis=1)][:200]
    for depth in (0.06, 0.15, 0.25):
        assert sides(points, normals, middle - depth * UP).min() > 0.5
        assert sides(points, normals, middle + depth * UP).max() < 0.25
    # Without the level, nothing is inside.
    assert sides(points, normals, middle - 0.06 * UP, may_be_open=False).max() < 0.55
    assert sides(points, normals, np.array([[0, 0, -1.0], [0, 0, -1.5], [1.2, 0, -0.2]])).max() < 0.25


def test_an_object_above_a_ground_has_an_inside() -> None:
    ground, (ball, outward) = plate(3000), sphere(400)
    points = np.concatenate([ground, 0.15 * ball + [0.2, -0.1, 0.2]])
    normals = np.concatenate([np.tile(UP, (3000, 1)), outward])
    inside = 0.08 * ball + [0.2, -0.1, 0.2]
    assert sides(points, normals, inside).min() > 0.75
    assert sides(points, normals, np.array([[0.2, -0.1, 0.42], [-0.3, 0.3, 0.1], [0.2, 0.2, 0.2]])).max() < 0.25
    assert sides(points, normals, inside, may_be_open=False).max() < 0.75


def test_no_winding_number_leaks_between_strips() -> None:
    points = strips()
    normals = np.tile(UP, (len(points), 1))
    rng = np.random.default_rng(3)
    # In the middle of the gaps.
    x, y = rng.choice(np.arange(-0.54, 0.5, 0.12), 300), rng.uniform(-0.5, 0.5, 300)
    for off, least, most in ((-0.05, 0.6, np.inf), (0.05, -np.inf, 0.4)):
        found = sides(points, normals, np.column_stack([x, y, height(x, y) + off]))
        assert ((found > least) & (found < most)).mean() > 0.98


@pytest.mark.parametrize("slope", [0.0, 0.5, 2.0])
def test_the_areas_of_a_sheet_are_those_of_its_triangles(slope: float) -> None:
    rng = np.random.default_rng(4)
    flat = np.concatenate([rng.uniform(0, 1, (500, 2)), [[0, 0], [0, 1], [1, 0], [1, 1]]])
    points = np.column_stack([flat, slope * flat[:, 0]])
    normals = np.tile(np.array([-slope, 0, 1]) / np.hypot(slope, 1), (len(points), 1))
    directions, radii = sheet_dipoles(points, normals, np.ones(len(points)))
    total = (directions * (np.pi * radii**2)[:, None]).sum(axis=0)
    np.testing.assert_allclose(total, [-slope, 0, 1], atol=1e-9)


def test_points_on_a_line_and_few_points_keep_their_disks() -> None:
    line = np.column_stack([np.linspace(0, 1, 20), np.zeros(20), np.zeros(20)])
    normals, disks = np.tile(UP, (20, 1)), np.full(20, 0.1)
    assert sheet_dipoles(line, normals, disks)[1] is disks
    assert scene_dipoles(line[:2], normals[:2], disks[:2])[2] == WindingLevel()
