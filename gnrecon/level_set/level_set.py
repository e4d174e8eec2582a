"""A differentiable field with its box: values, gradients and curvature in batches, for sampling and measuring."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from gnrecon.geometry.arrays import Float
from gnrecon.geometry.signed_distance import Box
from gnrecon.level_set.level_set_parameters import LevelSetParameters
from gnrecon.runtime.chunks import slices

Value = Callable[[Tensor], Tensor]
"""From points, of shape (N, 3), to f, of shape (N,)."""

ValueAndGradient = Callable[[Tensor], tuple[Tensor, Tensor]]
"""From points, of shape (N, 3), to f, of shape (N,), and grad f, of shape (N, 3)."""


@dataclass(frozen=True)
class LevelSet:
    """The zero level of a function within a box, in float64.

    Parameters
    ----------
    value : f of points of shape (N, 3), of shape (N,)
    value_and_gradient : the same with grad f, of shape (N, 3)
    box : where the surface is searched for, in the coordinates of f
    device : device of the points that f takes
    roughly : f to about a millionth, such as in float32, which is enough to find sign changes; by default `value`
    """

    value: Value
    value_and_gradient: ValueAndGradient
    box: Box
    device: torch.device = field(default_factory=lambda: torch.device("cpu"))
    roughly: Value | None = None

    @property
    def diagonal(self) -> float:
        """Length of the box's diagonal."""
        return float(np.linalg.norm(self.box.upper - self.box.lower))

    def tensor(self, array: Float) -> Tensor:
        """Return an array as a float64 tensor on the device."""
        return torch.as_tensor(np.asarray(array, np.float64)).to(self.device)

    @torch.no_grad()
    def values(self, points: Tensor) -> Tensor:
        """Return f, of shape (N,), at any number of points, of shape (N, 3), in batches."""
        return self._in_batches(self.value, points)

    @torch.no_grad()
    def rough_values(self, points: Tensor) -> Tensor:
        """Return f as `roughly` gives it, of shape (N,), at any number of points, of shape (N, 3), in batches."""
        return self._in_batches(self.roughly or self.value, points)

    def _in_batches(self, value: Value, points: Tensor) -> Tensor:
        return torch.cat([value(points[rows]) for rows in _batches(len(points))])

    @torch.no_grad()
    def values_and_gradients(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Return f, of shape (N,), and grad f, of shape (N, 3), in batches."""
        pairs = [self.value_and_gradient(points[rows]) for rows in _batches(len(points))]
        return torch.cat([value for value, _ in pairs]), torch.cat([gradient for _, gradient in pairs])

    def contains(self, points: Tensor) -> Tensor:
        """Return which points, of shape (N, 3), lie in the box, of shape (N,)."""
        lower, upper = self.tensor(self.box.lower), self.tensor(self.box.upper)
        return ((points >= lower) & (points <= upper)).all(1)


def _batches(count: int, *, batch_points: int = LevelSetParameters.batch_points) -> list[slice]:
    """Return slices that cover `count` rows, and one empty slice for no rows, so that results keep their shapes."""
    return slices(count, batch_points) or [slice(0, 0)]
