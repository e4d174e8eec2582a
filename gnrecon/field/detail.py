"""Local detail on top of a global network: one layer of sine features a cube, blended by a partition of unity.

    d(x) = sum_b w_b(x) sum_j a_bj sin(F_j . (x - c_b) / l_b + p_j)

All cubes share frequencies F and phases p; each has a centre c_b, a length l_b and output weights a_b of its own. Where
no cube holds x, d = 0. Coordinates are relative to the cube, so that single precision loses nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from gnrecon.field.features import Features
from gnrecon.field.partition import Partition
from gnrecon.geometry.arrays import Float, Int
from gnrecon.runtime.parallel import abreast, slices

ROWS = 512
"""Pairs of a point and a cube whose features are made at once: they stay in the processor's cache."""

TOGETHER, AROUND = 16_384, 131_072
"""Points that one thread evaluates at a time: any, and those around centres, which take less each."""


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
    """

    partition: Partition
    keys: Int
    lengths: Float
    features: Features
    amplitudes: Tensor
    position: float
    angle: float

    def __len__(self) -> int:
        return len(self.keys)

    @property
    def count(self) -> int:
        """Number of parameters."""
        return self.amplitudes.numel() + 4 * len(self.features) + len(self.lengths)

    def as_dict(self, scale: float) -> dict[str, float]:
        """Return what the data chose, as plain values; lengths in the unit of which `scale` make a radius."""
        return {
            "cubes": len(self),
            "features": len(self.features),
            "cell": scale * self.partition.cell,
            "length": scale * float(np.median(self.lengths)),
            "position_noise": scale * self.position,
            "angle_noise": float(np.degrees(self.angle)),
        }

    def to(self, dtype: torch.dtype) -> Detail:
        """Return the same detail with features of another precision."""
        return replace(self, features=self.features.to(dtype), amplitudes=self.amplitudes.to(dtype))

    def value(self, x: Float) -> Float:
        """Return d, of shape (N,), at x, of shape (N, 3)."""
        return self._blended(x, 0)[0]

    def value_and_gradient(self, x: Float) -> tuple[Float, Float]:
        """Return d, of shape (N,), and its gradient, of shape (N, 3), at x, of shape (N, 3)."""
        value, gradient = self._blended(x, 1)
        return value, gradient

    def value_around(self, x: Float, offsets: Float) -> Float:
        """Return d, of shape (N, K), at K offsets, of shape (K, 3), from each of x, of shape (N, 3)."""
        values = np.empty((len(x), len(offsets)))

        def fill(rows: slice) -> None:
            values[rows] = self._blend_around(x[rows], offsets)

        abreast(fill, slices(len(x), max(1, AROUND // len(offsets))), self.amplitudes.device)
        return values

    def hessian(self, x: Float) -> Float:
        """Return the second derivatives of d, of shape (N, 3, 3), at x, of shape (N, 3)."""
        return self._blended(x, 2)[2]

    def _blended(self, x: Float, order: int) -> list[Float]:
        """Return d and its derivatives up to an order."""
        sums = [np.empty((len(x), *(order_ * [3]))) for order_ in range(order + 1)]

        def fill(rows: slice) -> None:
            for total, part in zip(sums, self._blend(x[rows], order), strict=True):
                total[rows] = part

        abreast(fill, slices(len(x), TOGETHER), self.amplitudes.device)
        return sums

    def _blend(self, x: Float, order: int) -> list[Float]:
        """Return what `_blended` does for points of which all may be held at once, with all of their cubes."""
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
        """Return what `value_around` does, for centres of which all may be held at once, with all of their cubes."""
        keys, rows = self.partition.pairs_of_boxes(x + offsets.min(axis=0), x + offsets.max(axis=0))
        cubes = self._cubes(keys)
        by_cube = np.flatnonzero(cubes >= 0)
        by_cube = by_cube[np.argsort(cubes[by_cube], kind="stable")]
        rows, cubes = rows[by_cube], cubes[by_cube]
        values = np.zeros((len(x), len(offsets)))
        for some in np.split(np.arange(len(cubes)), np.flatnonzero(np.diff(cubes)) + 1) if len(cubes) else []:
            cube, near = cubes[some[0]], rows[some]
            center, length = self.partition.center(self.keys[cube]), float(self.lengths[cube])
            stencil = self.features.stencil(offsets / length)
            phase = self.features.phase(torch.as_tensor(x[near]), torch.as_tensor(center), length)
            own = stencil.sums(phase, self.amplitudes[cube]).double().cpu().numpy()
            points = torch.as_tensor((x[near][:, None] + offsets).reshape(-1, 3))
            weight = next(self.partition.weight(points, torch.as_tensor(center), 0)).numpy()
            # A centre has a cube once, so that no row is named twice.
            values[near] += weight.reshape(own.shape) * own
        return values

    def _own(self, points: Tensor, centers: Tensor, cubes: Int, order: int) -> list[Tensor]:
        """Return cubes' own functions with derivatives, each at one point, in double precision.

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
        for rows in slices(len(points), ROWS):
            sums = self.features.sums_of(local[rows], amplitudes[numbers[rows]], order)
            for whole, part in zip(own, sums, strict=True):
                whole[rows] = part
        # Derivatives are along x over the length so far.
        own = [part.double().cpu() for part in own]
        return [part / lengths.reshape(-1, *(k * [1])) ** k for k, part in enumerate(own)]

    def _cubes(self, keys: Int) -> Int:
        """Return the row of each cube by its key, of shape (P, 3), and -1 where no cube has it."""
        if not len(self):
            return np.full(len(keys), -1)
        low, extent, known, row = self._lookup
        inside = ((keys >= low) & (keys < low + extent)).all(axis=1)
        codes = _codes(keys[inside] - low, extent)
        at = np.minimum(np.searchsorted(known, codes), len(self) - 1)
        rows = np.full(len(keys), -1)
        rows[inside] = np.where(known[at] == codes, row[at], -1)
        return rows

    @cached_property
    def _lookup(self) -> tuple[Int, Int, Int, Int]:
        """The least key, how many there might be along each axis, the cubes' codes in order, and the row of each."""
        low, extent = self.keys.min(axis=0), np.ptp(self.keys, axis=0) + 1
        codes = _codes(self.keys - low, extent)
        order = np.argsort(codes, kind="stable")
        return low, extent, codes[order], order


def _codes(keys: Int, extent: Int) -> Int:
    """Return one number for each key, of shape (N, 3), of a lattice of so many cells along each axis."""
    codes: Int = (keys[:, 0] * extent[1] + keys[:, 1]) * extent[2] + keys[:, 2]
    return codes
