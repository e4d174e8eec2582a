"""Meshes as plain arrays: checks of shapes, vertex normals and attributes."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from gnrecon.geometry.mesh import Mesh, area_vectors
from gnrecon.runtime.errors import InputError

TRIANGLE = Mesh(np.eye(3), np.array([[0, 1, 2]]))


def test_attributes_must_have_a_row_for_each_vertex() -> None:
    with pytest.raises(InputError, match="2 values of 'height' do not fit 3 vertices"):
        Mesh(TRIANGLE.vertices, TRIANGLE.faces, attributes={"height": np.zeros(2)})


def test_attributes_are_added_to_those_that_are_there() -> None:
    mesh = TRIANGLE.with_attributes({"height": np.arange(3)}).with_attributes({"colors": np.zeros((3, 3), np.uint8)})
    assert set(mesh.attributes) == {"height", "colors"}
    assert not TRIANGLE.attributes


def test_attributes_go_with_moved_vertices() -> None:
    mesh = TRIANGLE.with_attributes({"height": np.arange(3)})
    assert mesh.with_vertices(2 * mesh.vertices).attributes["height"].tolist() == [0, 1, 2]


def test_a_face_cannot_name_a_vertex_that_is_not_there() -> None:
    with pytest.raises(InputError, match="outside of 0 to 2"):
        Mesh(TRIANGLE.vertices, np.array([[0, 1, 3]]))


def hull_of_a_sphere() -> Mesh:
    points = np.random.default_rng(0).normal(size=(300, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    faces = ConvexHull(points).simplices
    outward = np.einsum("ij,ij->i", area_vectors(points, faces), points[faces].mean(axis=1)) > 0
    return Mesh(points, np.where(outward[:, None], faces, faces[:, ::-1]))


def test_smooth_normals_are_a_spheres_own_however_irregular_its_faces() -> None:
    sphere = hull_of_a_sphere()
    np.testing.assert_allclose(sphere.smooth_normals(), sphere.vertices, atol=1e-10)
    # Area weights have errors of a degree and more.
    assert np.linalg.norm(sphere.vertex_normals() - sphere.vertices, axis=1).mean() > np.radians(1.0)


def test_smooth_normals_are_the_stored_ones() -> None:
    normals = np.tile([0.0, 0.0, 1.0], (3, 1))
    np.testing.assert_array_equal(Mesh(TRIANGLE.vertices, TRIANGLE.faces, normals).smooth_normals(), normals)


def test_smooth_normals_of_faces_of_no_area_and_of_vertices_of_no_face() -> None:
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 0, 0], [5, 5, 5]])
    normals = Mesh(vertices, np.array([[0, 1, 2], [1, 3, 2], [0, 1, 3]])).smooth_normals()
    np.testing.assert_allclose(normals, [[0, 0, 1], [0, 0, 1], [0, 0, 1], [0, 0, 0], [0, 0, 0]], atol=1e-12)


def test_a_folded_sliver_does_not_turn_smooth_normals() -> None:
    # A flat fan around the first vertex, and a tiny face that stands on it, upside down.
    angles = 2 * np.pi * np.arange(6) / 6
    ring = np.stack([np.cos(angles), np.sin(angles), np.zeros(6)], axis=1)
    vertices = np.concatenate([[[0.0, 0, 0]], ring, [[1e-3, 0, 0], [0, 1e-3, 0]]])
    fan = [[0, 1 + k, 1 + (k + 1) % 6] for k in range(6)]
    mesh = Mesh(vertices, np.array([*fan, [0, 8, 7]]))
    np.testing.assert_allclose(mesh.smooth_normals()[0], [0, 0, 1], atol=1e-6)
