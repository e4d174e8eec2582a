"""Meshes as plain arrays: what fits together, and what goes with the vertices."""

from __future__ import annotations

import numpy as np
import pytest

from gnrecon.errors import InputError
from gnrecon.mesh import Mesh

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
