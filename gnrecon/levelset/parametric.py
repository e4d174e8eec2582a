"""Surfaces that are known by a chart: points by area, and the nearest point, found in the chart's own parameters.

The nearest point X(u) to q minimises |X(u) - q|^2 / 2 over the parameters u. With the tangents T = dX/du, of shape
(3, 2), Gauss-Newton steps solve

    (T^T T + m tr(T^T T) I) du = T^T (q - X),

with a damping m for each point that falls while the distance does and rises when it does not (Levenberg-Marquardt).
They start at the nearest of many points of the surface, so that they find the nearest point and not just a near one;
to a query at distance d they contract by d x curvature, which for surfaces that agree is all but zero.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

_STARTS = 20_000
_ITERATIONS = 60
_GOLDEN = (5**0.5 - 1) / 2


@dataclass(frozen=True)
class ParametricSurface:
    """A patch of a smooth surface.

    Parameters
    ----------
    position : X of parameters of shape (N, 2), of shape (N, 3); also somewhat beyond the patch
    tangents : dX/du, of shape (N, 3, 2)
    parameters : takes the unit square, (N, 2), to the patch's parameters, (N, 2), by a constant factor of area
    inside : whether parameters belong to the patch, of shape (N,)
    """

    position: Callable[[Tensor], Tensor]
    tangents: Callable[[Tensor], Tensor]
    parameters: Callable[[Tensor], Tensor]
    inside: Callable[[Tensor], Tensor]

    def sample(self, count: int) -> tuple[Tensor, Tensor]:
        """Return points of the patch, of shape (count, 3), and the share of its area that each stands for, (count,)."""
        parameters = self._spread(count)
        t = self.tangents(parameters)
        areas = torch.linalg.vector_norm(torch.linalg.cross(t[:, :, 0], t[:, :, 1]), dim=1)
        return self.position(parameters), areas / areas.sum()

    def nearest(self, queries: Tensor) -> tuple[Tensor, Tensor]:
        """Return the nearest points, of shape (N, 3), of the surface to queries, (N, 3), and whether in the patch."""
        u = self._starts(queries)
        position = self.position(u)
        square = (position - queries).square().sum(1)
        damping = torch.full_like(square, 1e-3)
        for _ in range(_ITERATIONS):
            tried = u + self._step(u, queries - position, damping)
            new_position = self.position(tried)
            new_square = (new_position - queries).square().sum(1)
            better = new_square < square
            damping = torch.where(better, damping / 10, damping * 4).clamp(1e-12, 1e6)
            u = torch.where(better[:, None], tried, u)
            position = torch.where(better[:, None], new_position, position)
            square = torch.where(better, new_square, square)
        return position, self.inside(u)

    def _step(self, u: Tensor, toward: Tensor, damping: Tensor) -> Tensor:
        """Return the damped Gauss-Newton step of each point, of shape (N, 2)."""
        t = self.tangents(u)
        metric = t.mT @ t
        scale = metric.diagonal(dim1=1, dim2=2).sum(1).clamp_min(torch.finfo(t.dtype).tiny)
        damped = metric + (damping * scale)[:, None, None] * torch.eye(2, dtype=t.dtype)
        step: Tensor = torch.linalg.solve(damped, t.mT @ toward[:, :, None])[:, :, 0]
        return step

    def _starts(self, queries: Tensor) -> Tensor:
        """Return the parameters, of shape (N, 2), of the nearest among many points of the patch."""
        from scipy.spatial import cKDTree

        parameters = self._spread(_STARTS)
        nearest = cKDTree(self.position(parameters).numpy()).query(queries.numpy())[1]
        return parameters[torch.as_tensor(nearest)]

    def _spread(self, count: int) -> Tensor:
        """Return parameters, of shape (count, 2), spread over the patch by the golden ratio's lattice."""
        number = np.arange(count)
        square = np.stack([(number + 0.5) / count, (number * _GOLDEN) % 1.0], axis=1)
        return self.parameters(torch.as_tensor(square))
