"""Steep parts between neighbouring points of a sheet are supported; undersides, rims and wide gaps are not."""

from __future__ import annotations

import numpy as np

from gnrecon.export import distances_between_points
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.open_scenes import spacing_ratio

SPACING = 0.1


def step_scan() -> np.ndarray:
    """Points of a floor and of a step one high, without any on the step's side."""
    x, y = np.meshgrid(np.arange(-1, 1.01, SPACING), np.arange(-1, 1.01, SPACING))
    return np.column_stack([x.ravel(), y.ravel(), np.where(x.ravel() > 0.04, 1.0, 0.0)])


def patch(center: list[float], u: list[float], v: list[float]) -> Mesh:
    """A small square of two triangles, whose normal is u x v."""
    middle, a, b = (np.array(part, float) * scale for part, scale in ((center, 1), (u, 0.02), (v, 0.02)))
    corners = np.array([middle, middle + a, middle + a + b, middle + b])
    return Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))


def supported(mesh: Mesh, points: np.ndarray, reach: float = 2 * SPACING) -> bool:
    normals = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    far = np.full(len(mesh.vertices), 2 * reach)
    found = distances_between_points(mesh, far, points, normals, reach)
    assert ((found <= reach).all()) or (found == far).all()
    return bool((found <= reach).all())


def test_the_side_of_a_step_is_supported() -> None:
    points = step_scan()
    # The side faces the lower floor, in the direction -x.
    assert supported(patch([0.05, 0.0, 0.5], [0, 0, 1], [0, 1, 0]), points)
    assert not supported(patch([0.05, 0.0, 0.5], [0, 1, 0], [0, 0, 1]), points)


def test_undersides_rims_and_gaps_are_not() -> None:
    points = step_scan()
    assert not supported(patch([-0.5, 0.0, -0.02], [0, 1, 0], [1, 0, 0]), points)
    assert not supported(patch([-1.02, 0.0, -0.5], [0, 0, 1], [0, 1, 0]), points)
    apart = points[np.abs(points[:, 0]) > 0.35]
    assert not supported(patch([0.05, 0.0, 0.5], [0, 0, 1], [0, 1, 0]), apart)
    assert supported(patch([0.05, 0.0, 0.5], [0, 0, 1], [0, 1, 0]), apart, 0.8)


def test_supported_vertices_keep_their_distances() -> None:
    points, mesh = step_scan(), patch([-0.5, 0.0, 0.0], [1, 0, 0], [0, 1, 0])
    near = np.full(4, 0.05)
    normals = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    np.testing.assert_array_equal(distances_between_points(mesh, near, points, normals, 0.2), near)
    line = points[:5]
    np.testing.assert_array_equal(distances_between_points(mesh, near + 1, line, normals[:5], 0.2), near + 1)


def test_the_spacing_of_a_sheet_is_that_of_its_area() -> None:
    rng = np.random.default_rng(1)
    even = np.column_stack([rng.uniform(0, 1, (1000, 2)), np.zeros(1000)])
    up = np.array([[0.0, 0.0, 1.0]])
    assert spacing_ratio(even, np.repeat(up, 1000, axis=0)) == 1.0
    # Two thirds of the points in strips on a tenth of the area.
    x = np.repeat(np.linspace(0, 0.1, 4), 500) + rng.uniform(0, 0.001, 2000)
    strips = np.column_stack([x, rng.uniform(0, 1, 2000), np.zeros(2000)])
    both = np.concatenate([even[even[:, 0] > 0.1], strips])
    assert 2 < spacing_ratio(both, np.repeat(up, len(both), axis=0)) < 10
    line = np.column_stack([np.arange(20.0), np.zeros(20), np.zeros(20)])
    assert spacing_ratio(line, np.repeat(up, 20, axis=0)) == 1.0
