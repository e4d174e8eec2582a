"""Samples of free space in cubes, about a part of a sphere."""

from __future__ import annotations

import itertools
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from torch import Tensor

from gnrecon.field.partition_of_unity import Detail, Partition
from gnrecon.field.random_features import Features
from gnrecon.fit.free_space import CubeSpace, GroupSpace, Surroundings
from gnrecon.fit.parameters import FreeSpaceParameters
from gnrecon.geometry.octree import DipoleTree
from gnrecon.geometry.signed_distance import Box, Density, scene_dipoles

CENTER, REACH, LENGTH = np.array([1.0, 0.0, 0.0]), 0.3, 0.07
CELLS = Partition(CENTER - REACH / 1.3, 2 * REACH / 1.3)
KEY = np.zeros(3, dtype=np.int64)


class Zero:
    """A global field that is zero everywhere."""

    def value(self, theta: Tensor, x: Tensor) -> Tensor:
        return theta.new_zeros(len(x))


@pytest.fixture
def around(rng: np.random.Generator) -> Surroundings:
    points = rng.standard_normal((20_000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    density = Density(points)
    dipoles = DipoleTree.of(points, *scene_dipoles(points, points, density.disks))
    theta = torch.zeros(1, dtype=torch.float64)
    return Surroundings(Box.around(points, 0.5), density.tree, density.disks, dipoles, Zero(), theta)  # type: ignore[arg-type]


def space_of(around: Surroundings, noise: float = 0.0) -> CubeSpace:
    return CubeSpace(GroupSpace.of(around, CELLS, KEY[None], [LENGTH], noise), KEY)


@pytest.fixture
def space(around: Surroundings) -> CubeSpace:
    return space_of(around)


def test_no_wart_is_too_small_for_the_samples_near_the_data(space: CubeSpace, rng: np.random.Generator) -> None:
    limits, length = FreeSpaceParameters(), LENGTH
    near = space.near(length).volume
    # Wherever the sign is sure to be certain, a cell of the lattice has a sample, itself in that zone or next to it.
    places = CENTER + (REACH - limits.near_step_lengths * length) * rng.uniform(-1, 1, (2000, 3))
    off = np.abs(np.linalg.norm(places, axis=1) - 1.0)
    disk = float(space.group.around.disks.max())
    cell = limits.near_step_lengths * length * 3**0.5
    places = places[(off > 2.5 * disk) & (off < limits.near_reach_lengths * length - disk)]
    gaps = np.linalg.norm(places[:, None] - near.points, axis=2).min(axis=1)
    assert len(places) > 100
    assert gaps.max() < cell


def test_bounds_of_samples_near_the_data_have_the_sign_of_their_side(space: CubeSpace) -> None:
    near = space.near(LENGTH).volume
    outside = np.linalg.norm(near.points, axis=1) > 1.0
    assert 100 < outside.sum() < len(outside) - 100
    assert (np.abs(near.points - CENTER) <= REACH).all()
    assert (near.lower[outside] > 0).mean() > 0.99
    assert (near.upper[~outside] < 0).mean() > 0.99


def test_samples_near_the_data_keep_clear_of_its_noise(around: Surroundings, space: CubeSpace) -> None:
    limits, noise = FreeSpaceParameters(), 0.01
    near = space_of(around, noise).near(LENGTH).volume
    distance, nearest = around.tree.query(near.points)
    clear = limits.near_clearance_disk_radii * around.disks[nearest] + limits.near_clearance_noises * noise
    assert (distance > clear).all()
    exact = space.near(LENGTH).volume
    # The zone moves outwards as a whole: however noisy the data is, it is no narrower.
    assert around.tree.query(exact.points)[0].max() < limits.near_reach_lengths * LENGTH < distance.max()
    assert len(near.points) > 0.8 * len(exact.points)


def test_samples_of_the_whole_cube_are_clear_of_the_data_and_reach_into_its_corners(space: CubeSpace) -> None:
    far, around = space.far(), space.group.around
    distance, nearest = around.tree.query(far.points)
    assert (distance > FreeSpaceParameters.clearance_disk_radii * around.disks[nearest]).all()
    np.testing.assert_allclose(far.distance, distance)
    gap = FreeSpaceParameters.far_stride * space.group.grid.step
    for corner in itertools.product((-REACH, REACH), repeat=3):
        assert np.abs(far.points - CENTER - corner).max(axis=1).min() <= gap


@pytest.mark.parametrize("length", [LENGTH / 2, 1.4 * LENGTH])
def test_features_of_another_length_have_a_lattice_of_their_own(space: CubeSpace, length: float) -> None:
    limits = FreeSpaceParameters()
    of_length = GroupSpace.of(space.group.around, CELLS, KEY[None], [length], 0.0)
    near, own = space.near(length).volume, CubeSpace(of_length, KEY).near(length).volume
    np.testing.assert_array_equal(near.points, own.points)
    farthest = limits.near_reach_lengths * length
    assert 0.9 * farthest < near.distance.max() < farthest


def test_a_cube_of_a_group_has_the_samples_that_it_has_alone(around: Surroundings) -> None:
    keys = np.array(list(itertools.product((-1, 0), (-1, 0, 1), (0, 1))))
    group = GroupSpace.of(around, CELLS, keys, [LENGTH, 1.2 * LENGTH], 0.0)
    for key in keys:
        alone = CubeSpace(replace(group, keys=key[None]), key)
        shared = CubeSpace(group, key)
        np.testing.assert_allclose(shared.far().points, alone.far().points)
        for length in (LENGTH, 1.2 * LENGTH):
            near, expected = shared.near(length), alone.near(length)
            # The data is seen from elsewhere, so that its winding number, and whether that is certain, differs a bit.
            _, ours, theirs = np.intersect1d(near.rows, expected.rows, return_indices=True)
            assert len(ours) > 0.99 * max(len(near.rows), len(expected.rows), 1)
            found, other = near.volume.take(ours), expected.volume.take(theirs)
            np.testing.assert_array_equal(found.points, other.points)
            np.testing.assert_allclose(found.lower, other.lower, rtol=0.05)
            np.testing.assert_allclose(found.upper, other.upper, rtol=0.05)


def test_the_field_at_the_nodes_has_its_coarser_part(around: Surroundings, rng: np.random.Generator) -> None:
    features = Features.draw(40, rng, torch.zeros(0, dtype=torch.float64))
    cells = Partition(CENTER - 1.0, 0.9)
    keys, _ = cells.members(CENTER + 0.6 * rng.uniform(-1, 1, (200, 3)))
    lengths = np.where(keys[:, 0] > 0, 0.3, 0.2)
    coarser = Detail(cells, keys, lengths, features, 0.1 * torch.as_tensor(rng.standard_normal((len(keys), 40))), 0, 0)
    plain, corrected = (space_of(each) for each in (around, replace(around, coarser=coarser)))
    for one, other in ((plain.far(), corrected.far()), (plain.near(LENGTH).volume, corrected.near(LENGTH).volume)):
        np.testing.assert_array_equal(one.points, other.points)
        # The zero level is where the correction cancels the field.
        np.testing.assert_allclose(other.zero - one.zero, -coarser.value(one.points), atol=1e-9)
        assert np.abs(other.zero).max() > 0.05


def test_sums_at_the_nodes_are_those_of_the_features(space: CubeSpace, rng: np.random.Generator) -> None:
    draw = partial(Features.draw, 50, rng, torch.zeros(0, dtype=torch.float64))
    near, center = space.near(LENGTH), torch.as_tensor(CENTER)
    points, first = torch.as_tensor(near.volume.points), draw()
    assert len(points) > 100
    # The lattice keeps the sines of the latest features and length, and must not mistake others for them.
    for features, length in ((first, LENGTH), (first, 2 * LENGTH), (draw(), 2 * LENGTH), (first, LENGTH)):
        amplitudes = torch.as_tensor(rng.standard_normal(50))
        expected = features.sums(amplitudes, points, center, length, 0)[0]
        torch.testing.assert_close(near.sums(features, length)(amplitudes), expected, rtol=1e-9, atol=1e-9)
