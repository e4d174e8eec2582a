"""Blocks of a lattice's cells by an octree: a node is halved along all axes until it holds few enough points.

A block is a leaf of the tree: neighbouring cells, as many as share one node. Cells come in the order of their Morton
codes (the bits of the three numbers, interleaved), in which every node of the tree is one stretch; so do the points,
which can then lie in a file, block after block.
Source: Morton, A computer oriented geodetic data base (1966).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from gnrecon.geometry.arrays import Float, Int
from gnrecon.geometry.signed_distance import winding_number

BITS = 21
"""Of a cell's number along an axis: three of them make one code of 64 bits."""

Codes = npt.NDArray[np.uint64]

_SPREAD = ((32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F), (4, 0x10C30C30C30C30C3))

_LAST = (2, 0x1249249249249249)


def morton(cells: Int) -> Codes:
    """Return the Morton codes, of shape (N,), of cells of shape (N, 3), each number from 0 and below 2^21."""
    x, y, z = (_spread(cells[:, axis].astype(np.uint64)) for axis in range(3))
    codes: Codes = (x << np.uint64(2)) | (y << np.uint64(1)) | z
    return codes


def _spread(numbers: Codes) -> Codes:
    """Set two zeros between all bits of each number."""
    for shift, mask in (*_SPREAD, _LAST):
        numbers = (numbers | (numbers << np.uint64(shift))) & np.uint64(mask)
    return numbers


def octree_blocks(codes: Codes, counts: Int, most: int) -> list[slice]:
    """Return the leaves of the octree, in order, as slices of the cells.

    Parameters
    ----------
    codes : of shape (C,), the cells' Morton codes, ascending
    counts : of shape (C,), points in each cell
    most : points up to which a node is not halved; a single cell may hold more
    """
    before = np.concatenate([[0], np.cumsum(counts)])
    blocks: list[slice] = []
    # Children go onto the stack last first, so that leaves come off it in order.
    nodes = [(0, len(codes), BITS)] if len(codes) else []
    while nodes:
        first, last, bits = nodes.pop()
        if bits == 0 or last - first == 1 or before[last] - before[first] <= most:
            blocks.append(slice(first, last))
            continue
        octants = (codes[first:last] >> np.uint64(3 * (bits - 1))) & np.uint64(7)
        ends = first + np.searchsorted(octants, np.arange(9, dtype=np.uint64))
        nodes += [(int(a), int(b), bits - 1) for a, b in zip(ends[-2::-1], ends[:0:-1], strict=True) if b > a]
    return blocks


SIDE = 4.0
"""Of the smallest cubes, in radii of the disk that a point stands for in the median."""

FEW = 64
"""Cubes of the largest size, up to so many."""


# The generalised winding number of many oriented points, near some place: what is far off counts together.
#
# Points are gathered into cubes, those into cubes of twice the side, and so on. A cube of points far off acts as a
# single dipole: the sum of its points' normals times the areas that they stand for, at their mean place. For the
# queries in one box, a cube counts as a whole where the gap between both is wider than it; else the eight within it are
# asked. So each query costs some hundred terms however many points there are, and the smallest cubes are a few spacings
# wide, which is where the sign of the sum begins to be right. Source: Barill et al., Fast Winding Numbers for Soups and
# Clouds (2018), of first order, and Barnes and Hut (1986).


@dataclass(frozen=True)
class Level:
    """Occupied cubes of one size, in the order of their Morton codes.

    Parameters
    ----------
    lower : array of shape (C, 3), their lower corners
    side : float, or array of shape ()
    places : array of shape (C, 3), mean of the points, by area
    moments : array of shape (C, 3), sum of the dipoles
    radii : array of shape (C,), of the disk of as much area
    first : integer array of shape (C + 1,), where the children of each begin in the level of half the side
    """

    lower: Float
    side: float | Float
    places: Float
    moments: Float
    radii: Float
    first: Int


@dataclass(frozen=True)
class Dipoles:
    """Levels of cubes, the largest first."""

    levels: tuple[Level, ...]

    @classmethod
    def of(cls, points: Float, normals: Float, disks: Float) -> Dipoles:
        """Gather oriented points.

        Parameters
        ----------
        points, normals : arrays of shape (N, 3)
        disks : array of shape (N,), radius of the disk that each stands for
        """
        origin = points.min(axis=0)
        side = max(SIDE * float(np.median(disks)), float(np.ptp(points, axis=0).max()) / (1 << (BITS - 1)))
        codes = morton(np.floor((points - origin) / side).astype(np.int64))
        order = np.argsort(codes, kind="stable")
        areas = disks**2
        sums = np.column_stack([areas, areas[:, None] * points, areas[:, None] * normals / 4])[order]
        first: Int
        codes, first = codes[order], np.arange(len(points) + 1)
        codes, sums, first = _connected(codes, sums)
        levels = [_level(sums, first, origin, side)]
        while len(codes) > FEW:
            codes, sums, first = _connected(codes >> np.uint64(3), sums)
            side *= 2
            levels.append(_level(sums, first, origin, side))
        return cls(tuple(reversed(levels)))

    @classmethod
    def of_arrays(cls, array: Callable[[str], npt.NDArray[Any]], count: int) -> Dipoles:
        """Return the levels whose arrays a function gives by the names that `arrays` gave them."""
        names = [field.name for field in fields(Level)]
        return cls(tuple(Level(*(array(f"level{number}_{name}") for name in names)) for number in range(count)))

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """Return all arrays of the levels by names."""
        levels = enumerate(self.levels)
        return {
            f"level{number}_{field.name}": np.asarray(getattr(level, field.name))
            for number, level in levels
            for field in fields(Level)
        }

    def near(self, center: Float, reach: float) -> tuple[Float, Float, Float]:
        """Return places, moments and radii of what stands for all points, seen from a cube of half an edge `reach`."""
        found: list[tuple[Float, Float, Float]] = []
        rows = np.arange(len(self.levels[0].radii))
        for number, level in enumerate(self.levels):
            middle = level.lower[rows] + level.side / 2
            gap = np.abs(middle - center).max(axis=1) - reach - level.side / 2
            last = number == len(self.levels) - 1
            whole = rows if last else rows[gap > level.side]
            found.append((level.places[whole], level.moments[whole], level.radii[whole]))
            if not last:
                split = rows[gap <= level.side]
                rows = np.concatenate(
                    [np.arange(level.first[row], level.first[row + 1]) for row in split] or [rows[:0]]
                )
        places, moments, radii = (np.concatenate(parts) for parts in zip(*found, strict=True))
        return places, moments, radii

    def winding_number(self, x: Float, center: Float, reach: float) -> Float:
        """Return the winding number, of shape (Q,), at x, of shape (Q, 3), within a cube of half an edge `reach`."""
        return winding_number(x, *self.near(center, reach))


def _connected(codes: Codes, sums: Float) -> tuple[Codes, Float, Int]:
    """Sum the rows of equal codes, which are neighbours; where each began, with the end."""
    start = np.flatnonzero(np.r_[True, codes[1:] != codes[:-1]])
    return codes[start], np.add.reduceat(sums, start, axis=0), np.append(start, len(codes))


def _level(sums: Float, first: Int, origin: Float, side: float) -> Level:
    areas = np.maximum(sums[:, 0], np.finfo(np.float64).tiny)
    places = sums[:, 1:4] / areas[:, None]
    # The lower corner follows from any point within, such as the mean.
    lower = origin + side * np.floor((places - origin) / side)
    return Level(lower, side, places, sums[:, 4:], np.sqrt(areas), first)
