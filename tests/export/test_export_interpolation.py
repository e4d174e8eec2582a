"""A quantity known at some vertices only, against itself at all of them."""

from __future__ import annotations

import numpy as np
import pytest
from scan_files import torus

from gnrecon.export import interpolate_from_samples
from gnrecon.geometry.mesh import Mesh

FACE = np.array([[0, 1, 2]])


class Counted:
    """A smooth positive function over four decades that remembers how often it was asked."""

    def __init__(self) -> None:
        self.count = 0

    def __call__(self, points: np.ndarray) -> np.ndarray:
        self.count += len(points)
        return np.asarray(np.exp(3 * points[:, 0] - 2 * points[:, 1]))


@pytest.fixture
def mesh() -> Mesh:
    points, normals = torus(6000, np.random.default_rng(1))
    return Mesh(points, FACE, normals)


def test_few_vertices_are_all_computed(mesh: Mesh) -> None:
    quantity = Counted()
    assert np.array_equal(interpolate_from_samples(quantity, mesh), Counted()(mesh.vertices))
    assert quantity.count == len(mesh.vertices)


def test_the_others_are_interpolated(mesh: Mesh) -> None:
    quantity = Counted()
    found, exact = interpolate_from_samples(quantity, mesh, most=1500), Counted()(mesh.vertices)
    assert quantity.count == 1500
    ratio = np.abs(np.log(found / exact))
    assert (ratio < 1e-6).sum() >= 1500
    assert np.median(ratio) < 0.1
    assert ratio.max() < 0.7
    assert np.array_equal(found, interpolate_from_samples(Counted(), mesh, most=1500))


@pytest.mark.parametrize("offset", [0.0, 5e6])
def test_the_sides_of_a_thin_sheet_do_not_mix(offset: float) -> None:
    rng = np.random.default_rng(2)
    plane = rng.uniform(-1, 1, (3000, 2))
    up = np.arange(3000) % 2 == 0
    points = np.column_stack([plane, np.where(up, 0.005, -0.005)]) + offset
    normals = np.where(up[:, None], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0])
    found = interpolate_from_samples(
        lambda x: np.where(x[:, 2] > offset, 100.0, 1.0), Mesh(points, FACE, normals), most=1000
    )
    assert found[up].min() > 50
    assert found[~up].max() < 2


def test_a_quantity_that_vanishes_stays_finite(mesh: Mesh) -> None:
    found = interpolate_from_samples(lambda x: np.zeros(len(x)), mesh, most=500)
    assert np.isfinite(found).all()
    assert found.max() < 1e-300
