"""Clipping to a box: what is inside stays, borders lie on the sides, and the mesh is an edge-manifold."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from gnrecon.export import require_bordered
from gnrecon.export.trim import clip_to_box
from gnrecon.geometry.mesh import Mesh


def ball(subdivisions: int = 4) -> Mesh:
    made = trimesh.creation.icosphere(subdivisions)
    return Mesh(np.asarray(made.vertices), np.asarray(made.faces), np.asarray(made.vertices))


def grid(cells: int) -> Mesh:
    """A flat closed slab whose vertices lie on planes of a lattice over [-1, 1]^2."""
    box = trimesh.creation.box((2.0, 2.0, 0.5)).subdivide().subdivide().subdivide()
    del cells
    return Mesh(np.asarray(box.vertices), np.asarray(box.faces))


@pytest.mark.parametrize("upper", [0.05, 0.3, 0.77])
def test_a_ball_is_cut_by_a_plane(upper: float) -> None:
    bounds = np.array([[-2.0, -2.0, -2.0], [2.0, 2.0, upper]])
    part = clip_to_box(ball(), bounds)
    facts = require_bordered(part)
    assert facts.components == 1
    assert facts.euler_characteristic == 1
    # Archimedes: a zone's area is 2 pi times its height.
    assert facts.area == pytest.approx(2 * np.pi * (1 + upper), rel=0.01)
    assert part.vertices[:, 2].max() < upper + 0.01
    assert part.normals is not None
    assert len(part.normals) == len(part.vertices)


def test_two_sides_leave_a_ring() -> None:
    part = clip_to_box(ball(), np.array([[-2.0, -0.4, -2.0], [2.0, 0.4, 2.0]]))
    facts = require_bordered(part)
    assert facts.euler_characteristic == 0
    assert facts.area == pytest.approx(2 * np.pi * 0.8, rel=0.01)


def test_sides_on_the_lattice_cut_no_face() -> None:
    whole = grid(8)
    part = clip_to_box(whole, np.array([[-0.5, -0.5, -1.0], [0.5, 0.5, 1.0]]))
    require_bordered(part)
    np.testing.assert_allclose(part.vertices[:, :2].min(axis=0), -0.5, atol=1e-12)
    np.testing.assert_allclose(part.vertices[:, :2].max(axis=0), 0.5, atol=1e-12)
    assert part.area == pytest.approx(2.0)
    known = {tuple(row) for row in np.round(whole.vertices, 9)}
    assert all(tuple(row) in known for row in np.round(part.vertices, 9))


def test_a_mesh_inside_is_left_as_it_is() -> None:
    whole = ball(2)
    part = clip_to_box(whole, np.array([[-2.0] * 3, [2.0] * 3]))
    np.testing.assert_array_equal(part.vertices, whole.vertices)
    np.testing.assert_array_equal(part.faces, whole.faces)


def test_nothing_inside_is_nothing() -> None:
    assert len(clip_to_box(ball(2), np.array([[3.0] * 3, [4.0] * 3])).faces) == 0
