"""Damped normal equations by Cholesky: linearise once, solve for as many dampings as the search asks for.

A Gauss-Newton step minimises |r + J s|^2 + damping |s|_D^2, so that (J^T J + damping D) s = -J^T r. Its predicted
decrease of the loss |r|^2 / 2 is  -s^T J^T r - s^T J^T J s / 2 = (damping s^T D s - s^T J^T r) / 2, which is free of
cancellation.
D is the identity, or J^T J's own diagonal, which makes the damping independent of the parameters' scales.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import torch
from torch import Tensor

from gnrecon.linalg.gram import gram


@dataclass(frozen=True)
class Step:
    """A damped step, of shape (p,), and the decrease of the loss that the linear model predicts for it."""

    direction: Tensor
    predicted: float


@dataclass(frozen=True)
class DampedSystem:
    """The normal equations at one linearisation; `product` holds J^T J in its lower triangle, and is left unchanged."""

    product: Tensor
    projected: Tensor
    metric: Tensor
    loss: float

    def solve(self, damping: float) -> Step | None:
        """Return the step for `damping`, or None where the damped matrix is not positive definite or not finite."""
        damped = self.product.clone()
        damped.diagonal().add_(damping * self.metric)
        factor, failed = torch.linalg.cholesky_ex(damped)
        if int(failed) or not bool(torch.isfinite(self.projected).all()):
            return None
        # Two triangular solves: torch.cholesky_solve is about twenty times slower for one right-hand side.
        half = torch.linalg.solve_triangular(factor, -self.projected[:, None], upper=False)
        step = torch.linalg.solve_triangular(factor.T, half, upper=True)[:, 0]
        if not bool(torch.isfinite(step).all()):
            return None
        predicted = 0.5 * float(damping * (self.metric * step) @ step - step @ self.projected)
        return Step(step, predicted)


Metric = Callable[[Tensor], Tensor]


def identity(diagonal: Tensor) -> Tensor:
    """Damp every parameter alike (Levenberg), as the paper does."""
    return torch.ones_like(diagonal)


def jacobian_scaled(diagonal: Tensor) -> Tensor:
    """Damp in units of J^T J's diagonal (Marquardt), with a floor for parameters that no residual sees."""
    return diagonal.clamp_min(1e-12 * float(diagonal.max()) + torch.finfo(diagonal.dtype).tiny)


def normal_equations(
    chunks: Iterable[tuple[Tensor, Tensor]], size: int, like: Tensor, metric: Metric = identity
) -> DampedSystem:
    """Assemble the damped system from chunks of rows and residuals (see `gram`)."""
    product, projected, square = gram(chunks, size, like)
    return DampedSystem(product, projected, metric(product.diagonal()), 0.5 * square)
