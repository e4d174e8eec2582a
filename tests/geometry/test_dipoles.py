"""The winding number by a tree of dipoles, compared with the plain sum over all points."""

from __future__ import annotations

import numpy as np
import pytest

from gnrecon.geometry.octree import DipoleTree
from gnrecon.geometry.signed_distance import Density, winding_number

COUNT = 6000


def two_balls() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points, normals and disks of a ball and of a smaller one next to it."""
    rng = np.random.default_rng(0)
    normals = rng.standard_normal((COUNT, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    small = np.arange(COUNT) % 5 == 0
    points = np.where(small[:, None], [1.5, 0.0, 0.0] + 0.4 * normals, normals)
    return points, normals, Density(points).disks


def test_it_is_the_plain_sum_clear_of_the_points() -> None:
    points, normals, disks = two_balls()
    tree = DipoleTree.of(points, normals, disks)
    rng = np.random.default_rng(1)
    centers = rng.uniform([-1.2, -1.2, -1.2], [2.0, 1.2, 1.2], (40, 3))
    inside = 0
    for center in centers:
        x = center + rng.uniform(-0.1, 0.1, (50, 3))
        clear = np.linalg.norm(x[:, None] - points, axis=2).min(axis=1) > 1.5 * np.median(disks)
        plain = winding_number(x[clear], points, normals * (disks**2 / 4)[:, None], disks)
        found = winding_number(x[clear], *tree.dipoles_for(center, 0.1))
        assert found == pytest.approx(plain, abs=0.05)
        assert ((found > 0.5) == (plain > 0.5)).all()
        inside += int((found > 0.5).sum())
    assert inside > 100


def test_every_point_counts_once_and_few_terms_are_left() -> None:
    points, normals, disks = two_balls()
    tree = DipoleTree.of(points, normals, disks)
    assert len(tree.levels[0].radii) <= 64
    for center in ([0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [5.0, 5.0, 5.0]):
        places, moments, radii = tree.dipoles_for(np.array(center), 0.05)
        assert (radii**2).sum() == pytest.approx((disks**2).sum())
        assert moments.sum(axis=0) == pytest.approx((normals * (disks**2 / 4)[:, None]).sum(axis=0), abs=1e-9)
        assert len(places) < COUNT / 5


def test_arrays_bring_it_back() -> None:
    tree = DipoleTree.of(*two_balls())
    arrays = tree.arrays()
    again = DipoleTree.of_arrays(arrays.__getitem__, len(tree.levels), tree.sides)
    x = np.array([[0.1, 0.2, 0.0], [3.0, 0.0, 0.0]])
    assert (
        winding_number(x, *again.dipoles_for(x[0], 0.0)).tolist()
        == winding_number(x, *tree.dipoles_for(x[0], 0.0)).tolist()
    )


def tree(**limits: float) -> DipoleTree:
    rng = np.random.default_rng(0)
    normals = rng.standard_normal((2000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return DipoleTree.of(normals, normals, np.full(2000, 0.05), **limits)


def test_its_cubes_are_by_its_parameters() -> None:
    assert len(tree(root_cubes=8).levels[0].radii) <= 8 < len(tree().levels[0].radii) <= 64
    assert len(tree(leaf_side_radii=8.0).levels[-1].radii) < len(tree().levels[-1].radii)
