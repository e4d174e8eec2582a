"""The lattice of a partition of unity: nodes that its cubes share, in blocks in which sums of sines cost little."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import TypeVar

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from gnrecon.field.partition_of_unity import Partition, lattice_codes
from gnrecon.field.random_features import Features, Stencil
from gnrecon.geometry.arrays import Float, Int, Mask

Value = TypeVar("Value", bound=np.generic)


@dataclass(frozen=True)
class CubeLattice:
    """The nodes of a lattice in a cube, in blocks: at `offsets`, of shape (K, 3), from `corners`, of shape (C, 3).

    Corners are relative to the cube's centre. A sum of sines at all nodes takes the sines of corners and offsets alone,
    see `Stencil`. All cubes of a partition have the same lattice, so that these are the same for all of one length.
    """

    corners: Float
    offsets: Float
    _latest: list[tuple[Features, float, Stencil, Tensor]] = field(default_factory=list, repr=False, compare=False)

    def sums(self, features: Features, length: float, amplitudes: Tensor) -> Tensor:
        """Return the sums of features of a length about the centre at all nodes, of shape (C K,), block by block."""
        if not any(known is features and of_length == length for known, of_length, *_ in self._latest):
            corners = torch.as_tensor(self.corners, device=features.phases.device)
            phases = features.phase(corners, torch.zeros_like(corners[0]), length)
            self._latest[:] = [(features, length, features.stencil(self.offsets / length), phases)]
        _, _, stencil, phases = self._latest[0]
        return stencil.sums(phases, amplitudes.to(phases)).flatten()


@dataclass(frozen=True)
class NodeGrid:
    """The lattice of a partition: `count` nodes along each edge of a cell, and so many more that a cube sees beyond it.

    A cube's nodes come in blocks of `block` along each edge, of which the last may be beyond the cube.
    """

    partition: Partition
    count: int
    block: int = 4

    @classmethod
    def of(cls, partition: Partition, step: float) -> NodeGrid:
        """Return the lattice of nodes at most `step` apart."""
        return cls(partition, math.ceil(partition.cell / step))

    @property
    def step(self) -> float:
        """Between nodes."""
        return self.partition.cell / self.count

    @property
    def beyond(self) -> int:
        """Nodes of a cube beyond each face of its cell."""
        return math.floor(self.partition.overlap / 2 * self.count + 0.5)

    @property
    def edge(self) -> int:
        """Nodes along each edge of a cube."""
        return self.count + 2 * self.beyond

    @property
    def blocks(self) -> int:
        """Blocks along each edge of a cube."""
        return -(-self.edge // self.block)

    def first(self, keys: Int) -> Int:
        """Return the first node of cubes, of shape (B, 3), in nodes from the partition's origin."""
        return keys * self.count - self.beyond

    def places(self, nodes: Int) -> Float:
        """Return where nodes are, of shape (Q, 3)."""
        places: Float = self.partition.origin + self.step * (nodes + 0.5)
        return places

    def in_blocks(self, nodes: Int, stride: int) -> tuple[Float, Float, Int, Int]:
        """Return the blocks that hold some of every `stride` nodes, of shape (Q, 3).

        Returns
        -------
        centers, offsets : arrays of shape (C, 3) and (K, 3), of the blocks, and of their nodes from these
        block, inner : arrays of shape (Q,), the rows of these that each node has
        """
        edge = self.block * stride
        blocks = nodes // edge
        _, rows, of = np.unique(_codes(blocks), return_index=True, return_inverse=True)
        middle = stride * (self.block - 1) / 2
        offsets = stride * _places(self.block) - middle
        inner = np.ravel_multi_index(tuple((nodes % edge // stride).T), 3 * (self.block,))
        return self.places(edge * blocks[rows]) + self.step * middle, self.step * offsets, of, inner

    @cached_property
    def lattice(self) -> CubeLattice:
        """The nodes of a cube."""
        corners, offsets = _places(self.blocks), _places(self.block)
        first = (0.5 - self.beyond) * self.step - self.partition.cell / 2
        return CubeLattice(first + self.step * self.block * corners, self.step * offsets)

    @cached_property
    def inside(self) -> Mask:
        """Which nodes of the blocks are in the cube, block by block."""
        along = np.arange(self.blocks * self.block) < self.edge
        return self.by_blocks(along[:, None, None] & along[:, None] & along)

    def by_blocks(self, values: npt.NDArray[Value]) -> npt.NDArray[Value]:
        """Return values at a cube's nodes, of shape (blocks * block,) * 3, in the order of the blocks, flat."""
        flat: npt.NDArray[Value] = values.reshape(3 * (self.blocks, self.block)).transpose(0, 2, 4, 1, 3, 5).ravel()
        return flat


def _places(count: int) -> Float:
    """Return the places of a lattice of so many along each edge, from its first, of shape (count^3, 3)."""
    return np.stack(np.meshgrid(*3 * [np.arange(float(count))], indexing="ij"), axis=-1).reshape(-1, 3)


def cube_groups(keys: Int, edge: int) -> list[Int]:
    """Return the rows of the cubes, of keys of shape (B, 3) of at least -1, in each box of so many cells an edge."""
    return equal_rows((keys + 1) // edge)


def equal_rows(values: Int) -> list[Int]:
    """Return the rows of an array of shape (B, 3) that are equal, for each different row in their order."""
    if not len(values):
        return []
    codes = _codes(values)
    order = np.argsort(codes, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(codes[order])) + 1)


def _codes(values: Int) -> Int:
    """Return a number for each row of an array of shape (B, 3), in the rows' order."""
    return lattice_codes(values - values.min(axis=0), np.ptp(values, axis=0) + 1)
