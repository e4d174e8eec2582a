"""Samples of free space around the data of cubes, and what they ask of their corrections.

Far from the data a field is to be about the coarse distance. Nearer to it, down to where points no longer tell the side
by the winding number, it must at least keep that sign: without such samples, points that contradict each other, as in
a narrow crease, pull the correction so far beyond the surface that a wart grows next to it.

The samples are nodes of one lattice that belongs to the partition, as samples at random would miss most warts, which
are no larger than the length of the features. Neighbouring cubes share the nodes where they overlap, and each node is
looked at once for a whole group of cubes (`GroupSpace`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from gnrecon.field.cube_lattice import CubeLattice, NodeGrid, equal_rows
from gnrecon.field.networks import Siren
from gnrecon.field.partition_of_unity import Detail, Partition
from gnrecon.field.random_features import Features
from gnrecon.fit.parameters import CoarserFieldParameters, FreeSpaceParameters
from gnrecon.geometry.arrays import Float, Int, Mask
from gnrecon.geometry.octree import DipoleTree
from gnrecon.geometry.signed_distance import (
    Box,
    Density,
    film_distance,
    is_sign_certain,
    kd_tree_order,
    sample_near_surface,
    sign_of_winding,
    winding_number,
)
from gnrecon.runtime.chunks import slices


@dataclass(frozen=True)
class Volume:
    """Samples of space, of shape (Q, 3), where a correction is known roughly; the rest of shape (Q,).

    Parameters
    ----------
    wanted : target of the correction
    lower, upper : what it must be at least, and at most
    zero : what makes the corrected field vanish
    distance : how far the data is
    """

    points: Float
    wanted: Float
    lower: Float
    upper: Float
    zero: Float
    distance: Float

    @classmethod
    def around(
        cls,
        points: Float,
        own: Float,
        signed: Float,
        winding: Float,
        distance: Float,
        bound_share: float = FreeSpaceParameters.sign_bound_share,
        *,
        parameters: FreeSpaceParameters = FreeSpaceParameters(),
    ) -> Volume:
        """Return samples at which a field is to be about the coarse distance, and of its sign where that is certain.

        A field that is somewhat steeper or flatter than a distance needs no correction; forcing it to the distance
        would overshoot between samples. Nor does one of the other sign where the sign is uncertain, as in a cavity of
        which little was scanned: the smooth field closes it no worse. Above a hole the least distance is that of the
        film, see `film_distance`.

        Parameters
        ----------
        points : array of shape (Q, 3)
        own, signed : arrays of shape (Q,), the field, and the coarse distance
        winding : array of shape (Q,), the winding number w
        distance : array of shape (Q,), of the data
        bound_share : of the coarse distance, that the field must keep where the sign is certain
        """
        certain, film = is_sign_certain(winding), film_distance(signed, winding)
        near, far = parameters.least_field_share * film, parameters.most_field_share * signed
        agreed = certain | (own * signed > 0)
        wanted = np.where(agreed, own.clip(np.minimum(near, far), np.maximum(near, far)) - own, 0.0)
        bound = bound_share * film - own
        lower = np.where(certain & (signed > 0), bound, -np.inf)
        upper = np.where(certain & (signed < 0), bound, np.inf)
        return cls(points, wanted, lower, upper, -own, distance)

    @classmethod
    def none(cls) -> Volume:
        """Return no samples."""
        return cls(np.zeros((0, 3)), *np.zeros((5, 0)))

    def arrays(self) -> tuple[Float, Float, Float, Float, Float, Float]:
        """Return all six arrays."""
        return self.points, self.wanted, self.lower, self.upper, self.zero, self.distance

    def take(self, rows: Int | Mask) -> Volume:
        """Return some of the samples."""
        return Volume(*(values[rows] for values in self.arrays()))


@dataclass(frozen=True)
class LatticeVolume:
    """Samples at some nodes of a lattice, of shape (Q,) as rows of the nodes."""

    volume: Volume
    lattice: CubeLattice
    rows: Int

    def sums(self, features: Features, length: float) -> Callable[[Tensor], Tensor]:
        """Return the function from amplitudes, (m,), to sums of features of a length about the centre, (Q,)."""
        rows = torch.as_tensor(self.rows, device=features.phases.device)
        return lambda amplitudes: self.lattice.sums(features, length, amplitudes)[rows]


@dataclass(frozen=True)
class Surroundings:
    """What free space is measured with.

    Parameters
    ----------
    box : where the field is fitted
    tree, disks : of the points around, or of all: a k-d tree, and the radius of the disk of each
    dipoles : of all points
    network, theta : the global field in unit coordinates
    coarser : local fields that are added to the global one, if there are some
    signed_by : returns other signed distances than the coarse ones, for places and these, where a penalty fills holes
    parameters : FreeSpaceParameters
    """

    box: Box
    tree: Any
    disks: Float
    dipoles: DipoleTree
    network: Siren
    theta: Tensor
    coarser: Detail | None = None
    signed_by: Callable[[Float, Float], Float] | None = None
    parameters: FreeSpaceParameters = FreeSpaceParameters()

    def value(self, grid: NodeGrid, nodes: Int, stride: int) -> Float:
        """Return the field at some of every `stride` nodes, of shape (Q, 3), in single precision: bounds are wide."""
        theta = self.theta.float()
        value: Float = self.network.value(theta, torch.as_tensor(grid.places(nodes)).to(theta)).double().cpu().numpy()
        if self.coarser is None or not len(nodes):
            return value
        center, offsets, block, inner = grid.in_blocks(nodes, stride)
        return value + self.coarser.value_around(center, offsets)[block, inner]

    def clear(self, x: Float, disks: float, gap: float, most: float) -> tuple[Int, Float, Float]:
        """Return rows of places, of shape (Q, 3), that are clear of the data, their distances, and the data's disks.

        Clear is farther than so many radii of these disks, plus a gap, and nearer than `most`.
        """
        distance, nearest = self.tree.query(x, distance_upper_bound=most)
        # A place with no point within that distance has a row beyond the last.
        rows = np.flatnonzero(np.isfinite(distance))
        distance, radii = distance[rows], self.disks[nearest[rows]]
        kept = distance > disks * radii + gap
        return rows[kept], distance[kept], radii[kept]


class _Nodes(NamedTuple):
    """What is known at some nodes of a group: the row of each node, -1 where nothing is, of shape (X, Y, Z)."""

    rows: Int
    volume: Volume


@dataclass(frozen=True)
class GroupSpace:
    """Samples of the space of a group of cubes.

    Parameters
    ----------
    around : what they are measured with
    keys : of the cubes, of shape (B, 3)
    grid : the lattice
    length : longest of the cubes' features, over which a correction fades
    noise : standard deviation of the points' positions
    """

    around: Surroundings
    keys: Int
    grid: NodeGrid
    length: float
    noise: float

    @classmethod
    def of(
        cls, around: Surroundings, partition: Partition, keys: Int, lengths: Sequence[float], noise: float
    ) -> GroupSpace:
        """Return the space of cubes with features of these lengths."""
        grid = NodeGrid.of(partition, around.parameters.near_step_lengths * min(lengths))
        return cls(around, keys, grid, max(lengths), noise)

    def with_length(self, key: Int, length: float) -> GroupSpace:
        """Return this space if it is fine and wide enough for a cube with features of a length, or one of the cube."""
        if length <= self.length and self.grid.step <= self.around.parameters.near_step_lengths * length:
            return self
        return GroupSpace.of(self.around, self.grid.partition, key[None], [length], self.noise)

    @cached_property
    def far(self) -> _Nodes:
        """Every other node along each axis, where it lies clear of the data."""
        limits = self.around.parameters
        every = np.ix_(*((first + np.arange(size)) % limits.far_stride == 0 for first, size in self._extent))
        some = np.zeros_like(self._needed)
        some[every] = self._needed[every]
        bounds = limits.clearance_disk_radii, 0.0, np.inf, limits.sign_bound_share
        return self._nodes(some, *bounds, stride=limits.far_stride)

    @cached_property
    def near(self) -> _Nodes:
        """The nodes about the data, where the sign is certain."""
        limits = self.around.parameters
        clear, most = limits.near_clearance_noises * self.noise, self.reach(self.length)
        bounds = limits.near_clearance_disk_radii, clear, most, limits.near_bound_share
        return self._nodes(self._needed, *bounds, certain=True)

    def reach(self, length: float) -> float:
        """Return how far from the data the nodes near it are looked at, for features of a length."""
        limits = self.around.parameters
        return limits.near_reach_lengths * length + limits.near_clearance_noises * self.noise

    def at(self, key: Int) -> tuple[slice, slice, slice]:
        """Return the nodes of a cube among those of the group, whole blocks of them."""
        first, size = self.grid.first(key) - self._first, self.grid.blocks * self.grid.block
        x, y, z = (slice(int(start), int(start) + size) for start in first)
        return x, y, z

    @cached_property
    def _first(self) -> Int:
        """First node of the group, in nodes from the partition's origin."""
        return self.grid.first(self.keys.min(axis=0))

    @property
    def _extent(self) -> list[tuple[int, int]]:
        """First node and number of nodes along each axis."""
        sizes = np.ptp(self.keys, axis=0) * self.grid.count + self.grid.blocks * self.grid.block
        return [(int(first), int(size)) for first, size in zip(self._first, sizes, strict=True)]

    @cached_property
    def _needed(self) -> Mask:
        """Which nodes are in a cube, and in the box where the field is fitted."""
        needed = np.zeros([size for _, size in self._extent], dtype=bool)
        edge = self.grid.edge
        for x, y, z in self.grid.first(self.keys) - self._first:
            needed[x : x + edge, y : y + edge, z : z + edge] = True
        box = self.around.box
        for axis, (first, size) in enumerate(self._extent):
            along = self.grid.partition.origin[axis] + self.grid.step * (first + np.arange(size) + 0.5)
            out = (along <= box.lower[axis]) | (along >= box.upper[axis])
            np.moveaxis(needed, axis, 0)[out] = False
        return needed

    def _nodes(
        self,
        some: Mask,
        disks: float,
        gap: float,
        most: float,
        bound_share: float,
        certain: bool = False,
        stride: int = 1,
    ) -> _Nodes:
        """Return what is known at some of every `stride` nodes, those that are clear of the data.

        For `disks`, `gap` and `most` see `Surroundings.clear`; `certain` asks for those of a certain sign.
        """
        nodes = np.argwhere(some)
        x = self.grid.places(nodes + self._first)
        kept, distance, radii = self.around.clear(x, disks, gap, most)
        nodes, x = nodes[kept], x[kept]
        winding = self._winding(nodes, x, distance)
        if certain:
            kept = np.flatnonzero(is_sign_certain(winding))
            nodes, x = nodes[kept], x[kept]
            distance, radii, winding = distance[kept], radii[kept], winding[kept]
        # A surface seen through points is nearer than these: see `gnrecon.geometry.signed_distance`.
        signed = sign_of_winding(winding) * np.sqrt(distance**2 - radii**2)
        if self.around.signed_by is not None:
            signed = self.around.signed_by(x, signed)
        rows = np.full(some.shape, -1, dtype=np.int32)
        rows[tuple(nodes.T)] = np.arange(len(nodes))
        own, limits = self.around.value(self.grid, nodes + self._first, stride), self.around.parameters
        return _Nodes(rows, Volume.around(x, own, signed, winding, distance, bound_share, parameters=limits))

    def _winding(self, nodes: Int, x: Float, distance: Float, *, part_cells: int = 2) -> Float:
        """Return the winding number of the data at nodes, of shape (Q, 3), seen from parts of so many cells an edge."""
        dipoles, winding = self.around.dipoles, np.empty(len(x))
        sizes = np.array([size for _, size in self._extent])
        parts = np.rint(sizes / (part_cells * self.grid.count)).astype(np.int64).clip(1)
        for some in equal_rows(nodes * parts // sizes):
            winding[some] = _winding_of(x[some], dipoles)
        centred: Float = dipoles.sides.centred(winding, distance)
        return centred


@dataclass(frozen=True)
class CubeSpace:
    """The space of one cube of a group."""

    group: GroupSpace
    key: Int

    @property
    def center(self) -> Float:
        """Of the cube, unit coordinates."""
        return self.group.grid.partition.center(self.key)

    @property
    def reach(self) -> float:
        """Half of the cube's edge."""
        return self.group.grid.partition.reach

    def far(self) -> Volume:
        """Return samples of the whole cube that lie clear of the data."""
        rows = self.group.grid.by_blocks(self.group.far.rows[self.group.at(self.key)])
        return self.group.far.volume.take(rows[(rows >= 0) & self.group.grid.inside])

    def near(self, length: float) -> LatticeVolume:
        """Return samples all over the space about the data where the sign is certain, for features of a length."""
        group = self.group.with_length(self.key, length)
        rows = group.grid.by_blocks(group.near.rows[group.at(self.key)])
        places = np.flatnonzero((rows >= 0) & group.grid.inside)
        places = places[group.near.volume.distance[rows[places]] < group.reach(length)]
        return LatticeVolume(group.near.volume.take(rows[places]), group.grid.lattice, places)


def has_gaps(
    points: Float,
    density: Density,
    dipoles: DipoleTree,
    length: float,
    rng: np.random.Generator,
    *,
    group: int = 64,
    parameters: CoarserFieldParameters = CoarserFieldParameters(),
) -> bool:
    """Return whether there are places about the data, some lengths wide, where no sign is certain.

    Parameters
    ----------
    points, density, dipoles : array of shape (N, 3), and of these points
    length : of local fields
    rng : draws the places
    group : places whose winding number is summed together
    """
    spread = parameters.gap_spread_lengths * length
    x = sample_near_surface(points, spread, parameters.gap_samples, rng)
    distance, nearest = density.tree.query(x)
    clear = distance > FreeSpaceParameters.clearance_disk_radii * density.disks[nearest]
    x, distance = x[clear], distance[clear]
    order, found = kd_tree_order(x), 0
    for rows in (order[some] for some in slices(len(x), group)):
        winding = _winding_of(x[rows], dipoles)
        found += int((~is_sign_certain(dipoles.sides.centred(winding, distance[rows]))).sum())
    return found >= parameters.least_gap_samples


def _winding_of(x: Float, dipoles: DipoleTree) -> Float:
    """Return the winding number, of shape (Q,), at places that lie together, of shape (Q, 3)."""
    lower, upper = x.min(axis=0), x.max(axis=0)
    center = (lower + upper) / 2
    places, moments, disks = dipoles.dipoles_for(center, float((upper - lower).max()) / 2)
    # Seen from the centre, distances to dipoles near by keep their digits in single precision.
    return winding_number(x - center, places - center, moments, disks, dtype=torch.float32)
