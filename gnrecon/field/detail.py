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

from gnrecon.cloud import Float
from gnrecon.field.features import Features
from gnrecon.field.partition import Int, Partition

ROWS = 512
"""Points that are evaluated together: their features stay in the processor's cache."""


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

    def hessian(self, x: Float) -> Float:
        """Return the second derivatives of d, of shape (N, 3, 3), at x, of shape (N, 3)."""
        return self._blended(x, 2)[2]

    @cached_property
    def _numbers(self) -> dict[tuple[int, ...], int]:
        """The row of each cube, by its key."""
        return {tuple(key): number for number, key in enumerate(self.keys.tolist())}

    def _blended(self, x: Float, order: int) -> list[Float]:
        """Return d and its derivatives up to an order."""
        sums = [np.zeros((len(x), *(order_ * [3]))) for order_ in range(order + 1)]
        keys, members = self.partition.members(x)
        for key, rows in zip(keys.tolist(), members, strict=True):
            number = self._numbers.get(tuple(key))
            if number is None:
                continue
            for start in range(0, len(rows), ROWS):
                some = rows[start : start + ROWS]
                for total, part in zip(sums, self._weighted(x[some], number, order), strict=True):
                    total[some] += part.double().cpu().numpy()
        return sums

    def _weighted(self, x: Float, number: int, order: int) -> list[Tensor]:
        """Return w_b times cube b's own function, with derivatives by the product rule."""
        center = torch.as_tensor(self.partition.center(self.keys[number]))
        points = torch.as_tensor(x)
        weight = list(self.partition.weight(points, center, order))
        sums = self.features.sums(self.amplitudes[number], points, center, float(self.lengths[number]), order)
        own = [part.double().cpu() for part in sums]
        parts = [weight[0] * own[0]]
        if order >= 1:
            parts.append(weight[0][:, None] * own[1] + own[0][:, None] * weight[1])
        if order >= 2:
            cross = weight[1][:, :, None] * own[1][:, None, :]
            parts.append(weight[0][:, None, None] * own[2] + cross + cross.mT + own[0][:, None, None] * weight[2])
        return parts
