"""A smooth partition of unity: overlapping cubes on a lattice, whose weights sum to one everywhere.

A cube's weight is a product of three one-dimensional ones, each flat in the middle and falling to zero over the overlap
with the neighbour by the quintic s(a) = a^3 (10 - 15 a + 6 a^2). As s(a) + s(1 - a) = 1, neighbours sum to one without
a division, and the weights are twice continuously differentiable, so that a blend of smooth functions has curvature.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from gnrecon.geometry.arrays import Float, Int

OFFSETS = np.array(list(itertools.product((-1, 0, 1), repeat=3)))
_TURNS = np.array(list(itertools.product((False, True), repeat=3)))
"""Along which axes a cube is the neighbour of a point's own cell."""


@dataclass(frozen=True)
class Partition:
    """Cubes of edge `cell`, each widened so that it overlaps its neighbours.

    Parameters
    ----------
    origin : array of shape (3,)
        Where the lattice begins.
    cell : float
    overlap : float in (0, 1]
        Width of the zone in which two neighbours are blended, as a share of the cell.
    """

    origin: Float
    cell: float
    overlap: float = 0.3

    @property
    def reach(self) -> float:
        """Half the edge of a widened cube."""
        return self.cell * (1.0 + self.overlap) / 2

    def center(self, key: npt.ArrayLike) -> Float:
        """Return the centre, of shape (3,), of the cube with a key of three whole numbers, or (B, 3) of B keys."""
        center: Float = self.origin + self.cell * (np.asarray(key) + 0.5)
        return center

    def members(self, x: Float) -> tuple[Int, list[Int]]:
        """Return the keys, of shape (B, 3) and in order, of all cubes that hold some of x, and the rows each holds.

        Parameters
        ----------
        x : array of shape (N, 3)
        """
        keys, rows = self.pairs(x)
        order = np.lexsort((rows, keys[:, 2], keys[:, 1], keys[:, 0]))
        keys, rows = keys[order], rows[order]
        first = np.flatnonzero(np.r_[True, (np.diff(keys, axis=0) != 0).any(axis=1)] if len(keys) else [])
        return keys[first], np.split(rows, first[1:]) if len(first) else []

    def pairs(self, x: Float) -> tuple[Int, Int]:
        """Return every pair of a cube's key, of shape (P, 3), and a row of x that it holds, of shape (P,), by rows.

        Along each axis a point lies in its own cell, and in the zone of overlap of at most one neighbour.
        """
        u = (x - self.origin) / self.cell
        own = np.floor(u).astype(np.int64)
        beside = np.where(u - own < 0.5, -1, 1)
        overlaps = np.abs(u - (own + beside + 0.5)) < (1.0 + self.overlap) / 2
        held = np.stack([(overlaps | ~turn).all(axis=1) for turn in _TURNS], axis=1)
        rows, turns = np.nonzero(held)
        return own[rows] + _TURNS[turns] * beside[rows], rows

    def pairs_of_boxes(self, low: Float, high: Float) -> tuple[Int, Int]:
        """Return every pair of a cube's key, of shape (P, 3), and a row of the boxes that it meets, of shape (P,).

        Parameters
        ----------
        low, high : arrays of shape (N, 3)
            Corners of the boxes.
        """
        first, last = (
            turn((x - self.origin) / self.cell - 0.5 + sign * (1.0 + self.overlap) / 2).astype(np.int64)
            for turn, x, sign in ((np.ceil, low, -1.0), (np.floor, high, 1.0))
        )
        most = int((last - first).max(initial=0)) + 1
        steps = np.array(list(itertools.product(range(most), repeat=3)))
        keys = first[:, None] + steps
        rows, which = np.nonzero((keys <= last[:, None]).all(axis=2))
        return keys[rows, which], rows

    def weight(self, x: Tensor, center: Tensor, order: int) -> Iterator[Tensor]:
        """Yield the weight of the cube around `center`, and its derivatives up to an order of at most two.

        Parameters
        ----------
        x : of shape (N, 3), within the widened cube
        center : of shape (3,), or (N, 3) of a cube for each point
        order : int

        Yields
        ------
        Tensor
            Of shapes (N,), (N, 3) and (N, 3, 3).
        """
        t = (x - center) / self.cell
        inner, width = (1.0 - self.overlap) / 2, self.overlap
        a = (1.0 - (t.abs() - inner) / width).clamp(0.0, 1.0)
        step = a**3 * (10 - 15 * a + 6 * a**2)
        yield step.prod(dim=1)
        if order < 1:
            return
        slope = -t.sign() * (30 * a**2 * (1 - a) ** 2) / (width * self.cell)
        yield torch.stack([_product(slope, step, (i,)) for i in range(3)], dim=1)
        if order < 2:
            return
        bend = 60 * a * (1 - a) * (1 - 2 * a) / (width * self.cell) ** 2
        entries = [
            [_product(bend, step, (i,)) if i == j else _product(slope, step, (i, j)) for j in range(3)]
            for i in range(3)
        ]
        yield torch.stack([torch.stack(row, dim=1) for row in entries], dim=1)


def _product(changed: Tensor, others: Tensor, axes: tuple[int, ...]) -> Tensor:
    """Return the product over the three axes of `changed` on the named ones and of `others` elsewhere, shape (N,)."""
    factors = [changed[:, axis] if axis in axes else others[:, axis] for axis in range(3)]
    return factors[0] * factors[1] * factors[2]
