"""A smooth partition of unity: overlapping cubes on a lattice, whose weights sum to one everywhere.

A cube's weight is a product of three one-dimensional ones, each flat in the middle and falling to zero over the overlap
with the neighbour by the quintic s(a) = a^3 (10 - 15 a + 6 a^2). As s(a) + s(1 - a) = 1, neighbours sum to one without
a division, and the weights are twice continuously differentiable, so that a blend of smooth functions has curvature.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from gnrecon.field.field_parameters import FieldParameters
from gnrecon.field.random_features import Features, Stencil
from gnrecon.geometry.arrays import Float, Int, Mask
from gnrecon.runtime.chunks import slices
from gnrecon.runtime.parallel import map_in_threads


@functools.cache
def neighbour_offsets() -> Int:
    """Return the offsets of a cell and its 26 neighbours in keys, of shape (27, 3)."""
    return np.array(list(itertools.product((-1, 0, 1), repeat=3)))


@functools.cache
def _axis_subsets() -> Mask:
    """Return all subsets of the axes, of shape (8, 3): those along which a cube is a neighbour of a point's cell."""
    return np.array(list(itertools.product((False, True), repeat=3)))


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

    @classmethod
    def about(cls, x: Float, cell: float) -> Partition:
        """Return the cubes about points, of shape (N, 3): all of their keys are at least -1.

        The lattice is off the points by a part of a cell that no regular scan shares, so that no face runs along them.
        """
        return cls(x.min(axis=0) - 0.137 * cell, cell)

    @property
    def reach(self) -> float:
        """Half the edge of a widened cube."""
        return self.cell * (1.0 + self.overlap) / 2

    def center(self, key: npt.ArrayLike) -> Float:
        """Return the centre, of shape (3,), of the cube with a key of three whole numbers, or (B, 3) of B keys."""
        center: Float = self.origin + self.cell * (np.asarray(key) + 0.5)
        return center

    def members(self, x: Float) -> tuple[Int, list[Int]]:
        """Return the sorted keys, of shape (B, 3), of all cubes that contain some of x, and the rows in each.

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
        """Return every pair of a cube's key, of shape (P, 3), and a row of x in that cube, of shape (P,), by rows.

        Along each axis a point lies in its own cell and in the overlap with at most one neighbour.
        """
        u = (x - self.origin) / self.cell
        own = np.floor(u).astype(np.int64)
        neighbour = np.where(u - own < 0.5, -1, 1)
        overlaps = np.abs(u - (own + neighbour + 0.5)) < (1.0 + self.overlap) / 2
        subsets = _axis_subsets()
        inside = np.stack([(overlaps | ~axes).all(axis=1) for axes in subsets], axis=1)
        rows, numbers = np.nonzero(inside)
        return own[rows] + subsets[numbers] * neighbour[rows], rows

    def pairs_of_boxes(self, low: Float, high: Float, known: Int) -> tuple[Int, Int]:
        """Return every pair of a cube's key, of shape (P, 3), and a row of a box that it intersects, of shape (P,).

        Parameters
        ----------
        low, high : arrays of shape (N, 3)
            Corners of the boxes.
        known : array of shape (B, 3)
            Keys of which all must be among the pairs; others may be missing.
        """
        first, last = (
            turn((x - self.origin) / self.cell - 0.5 + sign * (1.0 + self.overlap) / 2).astype(np.int64)
            for turn, x, sign in ((np.ceil, low, -1.0), (np.floor, high, 1.0))
        )
        most = int((last - first).max(initial=0)) + 1
        if most**3 > len(known):
            # Boxes far larger than the cubes, as where two dense parts are far apart, hold fewer cubes than cells.
            rows, which = np.nonzero(((first[:, None] <= known) & (known <= last[:, None])).all(axis=2))
            return known[which], rows
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


# Local detail on top of a global network: one layer of sine features per cube, blended by a partition of unity.
#
#     d(x) = sum_b w_b(x) sum_j a_bj sin(F_j . (x - c_b) / l_b + p_j)
#
# All cubes share frequencies F and phases p; each has a centre c_b, a length l_b and output weights a_b of its own.
# If no cube contains x, d = 0. Another detail, of longer lengths, may be added.
# Coordinates are relative to the cube, so that single precision does not lose digits.


@dataclass(frozen=True)
class Detail:
    """Sine features in overlapping cubes.

    Parameters
    ----------
    partition : Partition
    keys : array of shape (B, 3)
        Of the cubes that have features, in order.
    lengths : array of shape (B,)
        Length scale of each cube's features, unit coordinates.
    features : Features
        Of all cubes, m in number.
    amplitudes : of shape (B, m)
    position, angle : float
        Standard deviations of the data's noise that the amplitudes were solved for: of positions along the normal, in
        unit coordinates, and of normals, in radians.
    coarser : Detail, optional
        One of longer lengths that is added.
    """

    partition: Partition
    keys: Int
    lengths: Float
    features: Features
    amplitudes: Tensor
    position: float
    angle: float
    coarser: Detail | None = None

    def __len__(self) -> int:
        return len(self.keys)

    @property
    def levels(self) -> Iterator[Detail]:
        """The detail itself and those that are added, from short to long lengths."""
        level: Detail | None = self
        while level is not None:
            yield level
            level = level.coarser

    @property
    def cubes(self) -> int:
        """Number of cubes of all levels."""
        return sum(map(len, self.levels))

    @property
    def count(self) -> int:
        """Number of parameters of all levels."""
        return sum(one.amplitudes.numel() + 4 * len(one.features) + len(one.lengths) for one in self.levels)

    def as_dict(self, scale: float) -> dict[str, float]:
        """Return the fitted values as plain numbers; lengths are multiplied by `scale`, the radius of the cloud."""
        return {
            "cubes": self.cubes,
            "features": len(self.features),
            "cell": scale * self.partition.cell,
            "length": scale * float(np.median(self.lengths)),
            "position_noise": scale * self.position,
            "angle_noise": float(np.degrees(self.angle)),
        }

    def to(self, dtype: torch.dtype) -> Detail:
        """Return the same detail with features of another precision."""
        coarser = None if self.coarser is None else self.coarser.to(dtype)
        return replace(self, features=self.features.to(dtype), amplitudes=self.amplitudes.to(dtype), coarser=coarser)

    def value(self, x: Float) -> Float:
        """Return d, of shape (N,), at x, of shape (N, 3)."""
        return self._blended(x, 0)[0]

    def value_and_gradient(self, x: Float) -> tuple[Float, Float]:
        """Return d, of shape (N,), and its gradient, of shape (N, 3), at x, of shape (N, 3)."""
        value, gradient = self._blended(x, 1)
        return value, gradient

    def value_around(
        self, x: Float, offsets: Float, *, batch_values: int = FieldParameters.batch_stencil_values
    ) -> Float:
        """Return d, of shape (N, K), at K offsets, of shape (K, 3), from each of x, of shape (N, 3)."""
        values = np.empty((len(x), len(offsets)))

        def fill(rows: slice) -> None:
            values[rows] = self._blend_around(x[rows], offsets)

        map_in_threads(fill, slices(len(x), max(1, batch_values // len(offsets))), self.amplitudes.device)
        return values if self.coarser is None else values + self.coarser.value_around(x, offsets)

    def hessian(self, x: Float) -> Float:
        """Return the second derivatives of d, of shape (N, 3, 3), at x, of shape (N, 3)."""
        return self._blended(x, 2)[2]

    def _blended(self, x: Float, order: int, *, batch_points: int = FieldParameters.batch_points) -> list[Float]:
        """Return d and its derivatives up to an order."""
        sums = [np.empty((len(x), *(order_ * [3]))) for order_ in range(order + 1)]

        def fill(rows: slice) -> None:
            for total, part in zip(sums, self._blend(x[rows], order), strict=True):
                total[rows] = part

        map_in_threads(fill, slices(len(x), batch_points), self.amplitudes.device)
        if self.coarser is not None:
            for total, part in zip(sums, self.coarser._blended(x, order), strict=True):
                total += part
        return sums

    def _blend(self, x: Float, order: int) -> list[Float]:
        """Return the result of `_blended` for one batch of points, with all of their cubes."""
        keys, rows = self.partition.pairs(x)
        cubes = self._cubes(keys)
        by_cube = np.flatnonzero(cubes >= 0)
        by_cube = by_cube[np.argsort(cubes[by_cube], kind="stable")]
        rows, cubes = rows[by_cube], cubes[by_cube]
        points, centers = torch.as_tensor(x[rows]), torch.as_tensor(self.partition.center(self.keys[cubes]))
        own = self._own(points, centers, cubes, order)
        weight = list(self.partition.weight(points, centers, order))
        parts = [weight[0] * own[0]]
        if order >= 1:
            parts.append(weight[0][:, None] * own[1] + own[0][:, None] * weight[1])
        if order >= 2:
            cross = weight[1][:, :, None] * own[1][:, None, :]
            parts.append(weight[0][:, None, None] * own[2] + cross + cross.mT + own[0][:, None, None] * weight[2])
        to = torch.as_tensor(rows)
        return [part.new_zeros(len(x), *part.shape[1:]).index_add_(0, to, part).numpy() for part in parts]

    def _blend_around(self, x: Float, offsets: Float) -> Float:
        """Return the result of `value_around` for one batch of centres, with all of their cubes."""
        keys, rows = self.partition.pairs_of_boxes(x + offsets.min(axis=0), x + offsets.max(axis=0), self.keys)
        cubes = self._cubes(keys)
        by_cube = np.flatnonzero(cubes >= 0)
        by_cube = by_cube[np.argsort(cubes[by_cube], kind="stable")]
        rows, cubes = rows[by_cube], cubes[by_cube]
        values, stencils = np.zeros((len(x), len(offsets))), dict[float, Stencil]()
        for some in np.split(np.arange(len(cubes)), np.flatnonzero(np.diff(cubes)) + 1) if len(cubes) else []:
            cube, near = cubes[some[0]], rows[some]
            center, length = self.partition.center(self.keys[cube]), float(self.lengths[cube])
            if length not in stencils:
                stencils[length] = self.features.stencil(offsets / length)
            phase = self.features.phase(torch.as_tensor(x[near]), torch.as_tensor(center), length)
            own = stencils[length].sums(phase, self.amplitudes[cube]).double().cpu().numpy()
            points = torch.as_tensor((x[near][:, None] + offsets).reshape(-1, 3))
            weight = next(self.partition.weight(points, torch.as_tensor(center), 0)).numpy()
            # A centre is paired with a cube once, so no row occurs twice.
            values[near] += weight.reshape(own.shape) * own
        return values

    def _own(
        self,
        points: Tensor,
        centers: Tensor,
        cubes: Int,
        order: int,
        *,
        batch_pairs: int = FieldParameters.batch_pairs,
        gpu_batch_pairs: int = FieldParameters.gpu_batch_pairs,
    ) -> list[Tensor]:
        """Return the functions of the cubes with derivatives, each at one point, in double precision.

        Parameters
        ----------
        points, centers : of shape (P, 3)
        cubes : array of shape (P,), in order
        order : int
        """
        lengths = torch.as_tensor(self.lengths[cubes])[:, None]
        local, amplitudes = self.features.local(points, centers, lengths), self.amplitudes
        numbers = torch.as_tensor(cubes, device=amplitudes.device)
        own = [amplitudes.new_empty(len(points), *(order_ * [3])) for order_ in range(order + 1)]
        on_cpu = amplitudes.device.type == "cpu"
        for rows in slices(len(points), batch_pairs if on_cpu else gpu_batch_pairs):
            sums = self.features.sums_of(local[rows], amplitudes[numbers[rows]], order)
            for whole, part in zip(own, sums, strict=True):
                whole[rows] = part
        # So far derivatives are with respect to x / length.
        own = [part.double().cpu() for part in own]
        return [part / lengths.reshape(-1, *(k * [1])) ** k for k, part in enumerate(own)]

    def _cubes(self, keys: Int) -> Int:
        """Return the row of each cube by its key, of shape (P, 3), and -1 where no cube has it."""
        if not len(self):
            return np.full(len(keys), -1)
        low, extent, known, row = self._lookup
        inside = ((keys >= low) & (keys < low + extent)).all(axis=1)
        codes = lattice_codes(keys[inside] - low, extent)
        at = np.minimum(np.searchsorted(known, codes), len(self) - 1)
        rows = np.full(len(keys), -1)
        rows[inside] = np.where(known[at] == codes, row[at], -1)
        return rows

    @cached_property
    def _lookup(self) -> tuple[Int, Int, Int, Int]:
        """The smallest key, the extent of the keys along each axis, the sorted codes of the cubes, and their rows."""
        low, extent = self.keys.min(axis=0), np.ptp(self.keys, axis=0) + 1
        codes = lattice_codes(self.keys - low, extent)
        order = np.argsort(codes, kind="stable")
        return low, extent, codes[order], order


def lattice_codes(keys: Int, extent: Int) -> Int:
    """Return one number for each key, of shape (N, 3), of a lattice with `extent` cells along each axis."""
    codes: Int = (keys[:, 0] * extent[1] + keys[:, 1]) * extent[2] + keys[:, 2]
    return codes
