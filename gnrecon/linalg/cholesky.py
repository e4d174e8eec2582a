"""Dense normal equations by Cholesky: one symmetric rank-k update, then a factorisation for each damping."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gnrecon.linalg.jacobian import Jacobian
from gnrecon.linalg.metric import Metric
from gnrecon.linalg.system import Equations, Linearisation, Step

INDEFINITE = "The damped matrix is not positive definite; a larger damping may help."


@dataclass(frozen=True)
class NormalSystem(Linearisation):
    """J^T J, in its lower triangle, which is left unchanged by `solve`."""

    product: Tensor

    def solve(self, damping: float, residual: Tensor | None = None) -> Step:
        """Return the exact step."""
        equations = self.equations.at(residual)
        obstacle = equations.obstacle(damping)
        if obstacle:
            return equations.failed(obstacle)
        factor = self._factor(damping, lambda: damped_factor(self.product, damping * equations.metric))
        if factor is None:
            return equations.failed(INDEFINITE)
        return equations.step(solve_factored(factor, -equations.gradient), damping)


@dataclass(frozen=True)
class Cholesky:
    """Dense normal equations: O(M p^2) to linearise, O(p^3) a damping, p^2 numbers of memory.

    It squares the condition number of J, so that in float64 dampings below about 1e-14 of J^T J's largest eigenvalue
    are lost in rounding; see `QR`.
    """

    def linearise(self, jacobian: Jacobian, residual: Tensor, metric: Metric) -> NormalSystem:
        """Assemble J^T J."""
        return NormalSystem(Equations.of(jacobian, residual, metric), jacobian.gram())

    def describe(self) -> str:
        """Name the solver."""
        return "Dense normal equations by Cholesky."


def damped_factor(product: Tensor, diagonal: Tensor, overwrite: bool = False) -> Tensor | None:
    """Return the lower Cholesky factor of `product` + diag(`diagonal`), or None where that is not positive definite.

    With `overwrite`, `product` is not kept as it was, which spares a copy.
    """
    damped = product if overwrite else product.clone()
    damped.diagonal().add_(diagonal)
    factor, failed = torch.linalg.cholesky_ex(damped)
    return None if int(failed) or not bool(torch.isfinite(factor.diagonal()).all()) else factor


def solve_factored(factor: Tensor, right: Tensor) -> Tensor:
    """Return (L L^T)^-1 b for b of shape (p,)."""
    # Two triangular solves: torch.cholesky_solve is about twenty times slower for one right-hand side.
    half = torch.linalg.solve_triangular(factor, right[:, None], upper=False)
    solution: Tensor = torch.linalg.solve_triangular(factor.T, half, upper=True)
    return solution[:, 0]
