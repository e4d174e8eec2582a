"""Samples of free space in a cube, about a part of a sphere."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from gnrecon.field.random_features import Features
from gnrecon.fit.free_space import CubeSpace
from gnrecon.fit.parameters import FreeSpaceParameters
from gnrecon.geometry.octree import DipoleTree
from gnrecon.geometry.signed_distance import Box, Density, scene_dipoles

CENTER, REACH = np.array([1.0, 0.0, 0.0]), 0.3


class Zero:
    """A global field that is zero everywhere."""

    def value(self, theta: Tensor, x: Tensor) -> Tensor:
        return theta.new_zeros(len(x))

    def around(self, theta: Tensor, offsets: Tensor) -> Callable[[Tensor], Tensor]:
        return lambda x: theta.new_zeros(len(x), len(offsets))


@pytest.fixture
def space(rng: np.random.Generator) -> CubeSpace:
    points = rng.standard_normal((20_000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    density = Density(points)
    dipoles = DipoleTree.of(points, *scene_dipoles(points, points, density.disks))
    theta = torch.zeros(1, dtype=torch.float64)
    whole = Box.around(points, 0.5), density.tree, density.disks, dipoles
    return CubeSpace(CENTER, REACH, *whole, Zero(), theta, rng)  # type: ignore[arg-type]


def test_no_wart_is_too_small_for_the_samples_near_the_data(space: CubeSpace, rng: np.random.Generator) -> None:
    limits, length = FreeSpaceParameters(), 0.07
    near = space.near(length, 0.0).volume
    # Wherever the sign is sure to be certain, a cell of the lattice has a sample, itself in that zone or next to it.
    places = CENTER + (REACH - limits.near_step_lengths * length) * rng.uniform(-1, 1, (2000, 3))
    off = np.abs(np.linalg.norm(places, axis=1) - 1.0)
    disk = float(space.disks.max())
    cell = limits.near_step_lengths * length * 3**0.5
    places = places[(off > 2.5 * disk) & (off < limits.near_reach_lengths * length - disk)]
    gaps = np.linalg.norm(places[:, None] - near.points, axis=2).min(axis=1)
    assert len(places) > 100
    assert gaps.max() < cell


def test_bounds_of_samples_near_the_data_have_the_sign_of_their_side(space: CubeSpace) -> None:
    near = space.near(0.07, 0.0).volume
    outside = np.linalg.norm(near.points, axis=1) > 1.0
    assert 100 < outside.sum() < len(outside) - 100
    assert (np.abs(near.points - CENTER) <= REACH).all()
    assert (near.lower[outside] > 0).mean() > 0.99
    assert (near.upper[~outside] < 0).mean() > 0.99


def test_samples_near_the_data_keep_clear_of_its_noise(space: CubeSpace) -> None:
    limits, noise = FreeSpaceParameters(), 0.01
    near = space.near(0.07, noise).volume
    distance, nearest = space.tree.query(near.points)
    clear = limits.near_clearance_disk_radii * space.disks[nearest] + limits.near_clearance_noises * noise
    assert (distance > clear).all()
    exact = space.near(0.07, 0.0).volume
    # The zone moves outwards as a whole: however noisy the data is, it is no narrower.
    assert space.tree.query(exact.points)[0].max() < limits.near_reach_lengths * 0.07 < distance.max()
    assert len(near.points) > 0.8 * len(exact.points)


def test_sums_at_the_nodes_are_those_of_the_features(space: CubeSpace, rng: np.random.Generator) -> None:
    length, features = 0.07, Features.draw(50, rng, torch.zeros(0, dtype=torch.float64))
    amplitudes = torch.as_tensor(rng.standard_normal(50))
    near = space.near(length, 0.0)
    points = torch.as_tensor(near.volume.points)
    expected = features.sums(amplitudes, points, torch.as_tensor(CENTER), length, 0)[0]
    assert len(points) > 100
    torch.testing.assert_close(near.sums(features, length)(amplitudes), expected, rtol=1e-9, atol=1e-9)
