"""Octrees over Morton codes: blocks of neighbouring cells, and a tree of dipoles for the winding number of points.

Morton codes interleave the bits of a cell's three numbers. In their order every node of an octree is one range of cells
and of points, which can be stored in a file block after block. A block is a node that holds few enough points.

The tree of dipoles gathers points in cubes, these in cubes of twice the side, and so on. A distant cube acts as one
dipole: the sum of its points' normals times the areas that they represent, at their mean position. For the queries in
one box, a cube counts as a whole where the gap between both is wider than the cube; otherwise its eight children are
examined. So each query costs some hundred terms however many points there are.
Sources: Morton, A computer oriented geodetic data base (1966); Barill et al., Fast Winding Numbers for Soups and Clouds
(2018), of first order; Barnes and Hut (1986). Entries: `octree_blocks`, `DipoleTree`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from gnrecon.geometry.arrays import Float, Int
from gnrecon.geometry.open_scenes import WindingLevel

MORTON_BITS = 21
"""Bits of a cell's number along an axis: three of them fit a code of 64 bits."""

Codes = npt.NDArray[np.uint64]


def morton_codes(cells: Int) -> Codes:
    """Return the Morton codes, of shape (N,), of cells of shape (N, 3), each number from 0 and below 2^21."""
    x, y, z = (_with_gaps(cells[:, axis].astype(np.uint64)) for axis in range(3))
    codes: Codes = (x << np.uint64(2)) | (y << np.uint64(1)) | z
    return codes


def _with_gaps(numbers: Codes) -> Codes:
    """Return numbers with two zeros between all bits, by moving ever smaller groups of bits apart."""
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        numbers = (numbers | (numbers << np.uint64(shift))) & np.uint64(mask)
    return numbers


def octree_blocks(codes: Codes, counts: Int, most: int) -> list[slice]:
    """Return the leaves of the octree, in order, as slices of the cells.

    Parameters
    ----------
    codes : of shape (C,), the cells' Morton codes, ascending
    counts : of shape (C,), points in each cell
    most : points of a node that is not divided further; a single cell may hold more
    """
    before = np.concatenate([[0], np.cumsum(counts)])
    blocks: list[slice] = []
    # Children go onto the stack last first, so that leaves come off it in order.
    nodes = [(0, len(codes), MORTON_BITS)] if len(codes) else []
    while nodes:
        first, last, bits = nodes.pop()
        if bits == 0 or last - first == 1 or before[last] - before[first] <= most:
            blocks.append(slice(first, last))
            continue
        # The three bits of this level say in which of the eight children a cell is.
        octants = (codes[first:last] >> np.uint64(3 * (bits - 1))) & np.uint64(7)
        ends = first + np.searchsorted(octants, np.arange(9, dtype=np.uint64))
        nodes += [(int(a), int(b), bits - 1) for a, b in zip(ends[-2::-1], ends[:0:-1], strict=True) if b > a]
    return blocks


@dataclass(frozen=True)
class DipoleLevel:
    """Occupied cubes of one size, in the order of their Morton codes.

    Parameters
    ----------
    lower : array of shape (C, 3), their lower corners
    side : float, or array of shape ()
    places : array of shape (C, 3), mean of the points, weighted by area
    moments : array of shape (C, 3), sum of the dipoles
    radii : array of shape (C,), of the disk of the same area
    first : integer array of shape (C + 1,), first child of each in the level of half the side
    """

    lower: Float
    side: float | Float
    places: Float
    moments: Float
    radii: Float
    first: Int


@dataclass(frozen=True)
class DipoleTree:
    """Levels of cubes, the largest first, and the level of the winding number that divides inside from outside."""

    levels: tuple[DipoleLevel, ...]
    sides: WindingLevel = WindingLevel()

    @classmethod
    def of(
        cls,
        points: Float,
        normals: Float,
        disks: Float,
        sides: WindingLevel = WindingLevel(),
        *,
        leaf_side_radii: float = 0.5,
        root_cubes: int = 64,
    ) -> DipoleTree:
        """Return the tree of oriented points.

        Parameters
        ----------
        points, normals : arrays of shape (N, 3)
        disks : array of shape (N,), radius of the disk that each represents
        sides : the level of the winding number that divides inside from outside
        leaf_side_radii : side of the smallest cubes, in the median of these radii; with points that are so near to
            each other, the sign is right from about a radius off the surface on
        root_cubes : of the largest size at most
        """
        origin = points.min(axis=0)
        side = max(
            leaf_side_radii * float(np.median(disks)), float(np.ptp(points, axis=0).max()) / (1 << (MORTON_BITS - 1))
        )
        codes = morton_codes(np.floor((points - origin) / side).astype(np.int64))
        order = np.argsort(codes, kind="stable")
        # Areas in units of pi, so that the dipole a n / (4 pi) of the winding number is this area times n / 4.
        areas = disks**2
        sums = np.column_stack([areas, areas[:, None] * points, areas[:, None] * normals / 4])[order]
        first: Int
        codes, first = codes[order], np.arange(len(points) + 1)
        codes, sums, first = _connected(codes, sums)
        levels = [_level(sums, first, origin, side)]
        # A code without its last three bits is that of the cube of twice the side.
        while len(codes) > root_cubes:
            codes, sums, first = _connected(codes >> np.uint64(3), sums)
            side *= 2
            levels.append(_level(sums, first, origin, side))
        return cls(tuple(reversed(levels)), sides)

    @classmethod
    def of_arrays(cls, array: Callable[[str], npt.NDArray[Any]], count: int, sides: WindingLevel) -> DipoleTree:
        """Return the tree from its arrays, which a function returns by the names of `arrays`."""
        names = [field.name for field in fields(DipoleLevel)]
        levels = (DipoleLevel(*(array(f"level{number}_{name}") for name in names)) for number in range(count))
        return cls(tuple(levels), sides)

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """Return the arrays of all levels, by name."""
        levels = enumerate(self.levels)
        return {
            f"level{number}_{field.name}": np.asarray(getattr(level, field.name))
            for number, level in levels
            for field in fields(DipoleLevel)
        }

    def dipoles_for(self, center: Float, reach: float) -> tuple[Float, Float, Float]:
        """Return positions, moments and radii of dipoles for all points, seen from a box of half an edge `reach`."""
        found: list[tuple[Float, Float, Float]] = []
        rows: Int = np.arange(len(self.levels[0].radii))
        for number, level in enumerate(self.levels):
            middle = level.lower[rows] + level.side / 2
            gap = np.abs(middle - center).max(axis=1) - reach - level.side / 2
            last = number == len(self.levels) - 1
            whole = rows if last else rows[gap > level.side]
            found.append((level.places[whole], level.moments[whole], level.radii[whole]))
            if not last:
                split = rows[gap <= level.side]
                rows = ranges(level.first[split], level.first[split + 1])
        places, moments, radii = (np.concatenate(parts) for parts in zip(*found, strict=True))
        return places, moments, radii


def ranges(first: Int, end: Int) -> Int:
    """Return the numbers from each first one to before its end, one range after the other."""
    counts = end - first
    starts = np.cumsum(counts) - counts
    numbers: Int = np.arange(int(counts.sum())) + np.repeat(first - starts, counts)
    return numbers


def _connected(codes: Codes, sums: Float) -> tuple[Codes, Float, Int]:
    """Return each code once, the sums of its rows, which are adjacent, and the first row of each, with the end."""
    start = np.flatnonzero(np.r_[True, codes[1:] != codes[:-1]])
    return codes[start], np.add.reduceat(sums, start, axis=0), np.append(start, len(codes))


def _level(sums: Float, first: Int, origin: Float, side: float) -> DipoleLevel:
    """Return a level from its sums, of shape (C, 7): areas, areas times points, and dipoles."""
    # Points of zero area, where several coincide, would divide by zero.
    areas = np.maximum(sums[:, 0], np.finfo(np.float64).tiny)
    places = sums[:, 1:4] / areas[:, None]
    # The lower corner follows from any point within, such as the mean.
    lower = origin + side * np.floor((places - origin) / side)
    return DipoleLevel(lower, side, places, sums[:, 4:], np.sqrt(areas), first)
