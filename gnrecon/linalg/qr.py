"""Least squares by QR, without squaring the condition number.

J = Q R is reduced chunk by chunk: R <- qr([R; chunk]), and the residual beside it as one more column, so that Q^T r
comes out too and J is never held. For each damping, [R; sqrt(damping D)] is reduced once more; its R' gives R'^T R' =
J^T J + damping D, and R' s = -Q'^T (Q^T r, 0). Source: Demmel, Grigori, Hoemmen, Langou, Communication-optimal
parallel and sequential QR (2012); the paper solves its normal equations by QR as well, on the square matrix J^T J +
damping I.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gnrecon.linalg.jacobian import Jacobian
from gnrecon.linalg.metric import Metric
from gnrecon.linalg.system import Equations, Linearisation, Step


@dataclass(frozen=True)
class ReducedSystem(Linearisation):
    """R and Q^T r beside each other, of shape (min(M, p + 1), p + 1)."""

    reduced: Tensor

    def solve(self, damping: float, residual: Tensor | None = None) -> Step:
        """Return the exact step; for other residuals, by R'^T R' alone, which squares the condition number."""
        equations = self.equations.at(residual)
        obstacle = equations.obstacle(damping)
        if obstacle:
            return equations.failed(obstacle)
        full = self._factor(damping, lambda: self._damped(damping))
        if full is None:
            return equations.failed("The damped matrix is singular; a larger damping may help.")
        p = len(equations.gradient)
        if residual is None:
            half = -full[:p, p:]
        else:
            half = torch.linalg.solve_triangular(full[:p, :p].T, -equations.gradient[:, None], upper=False)
        step = torch.linalg.solve_triangular(full[:p, :p], half, upper=True)[:, 0]
        return equations.step(step, damping)

    def _damped(self, damping: float) -> Tensor | None:
        """Return [R', Q'^T (Q^T r, 0)], or None where R' is singular."""
        metric = self.equations.metric
        p = len(metric)
        below = torch.cat([torch.diag((damping * metric).sqrt()), self.reduced.new_zeros(p, 1)], 1)
        full = torch.linalg.qr(torch.cat([self.reduced, below]), mode="r").R
        diagonal = full.diagonal()[:p].abs()
        # A column that depends on those before it leaves a zero, or what rounding made of it, on the diagonal.
        lengths = torch.linalg.vector_norm(full[:, :p], dim=0)
        return full if bool((diagonal > torch.finfo(full.dtype).eps * lengths).all()) else None


@dataclass(frozen=True)
class QR:
    """Orthogonal reduction: twice the work of `Cholesky`, but accurate to the condition of J itself."""

    def linearise(self, jacobian: Jacobian, residual: Tensor, metric: Metric) -> ReducedSystem:
        """Reduce [J, r]."""
        residual = residual.to(jacobian.dtype)
        equations = Equations.of(jacobian, residual, metric)
        width = jacobian.columns + 1
        reduced = torch.zeros(0, width, dtype=jacobian.dtype, device=jacobian.device)
        pending, start = [reduced], 0
        for chunk in jacobian.dense():
            stop = start + len(chunk)
            pending.append(torch.cat([chunk.to(jacobian.dtype), residual[start:stop, None]], 1))
            start = stop
            # Reductions of fewer rows than columns would cost as much as those of many.
            if sum(len(part) for part in pending) > 2 * width:
                pending = [_reduce(pending)]
        return ReducedSystem(equations, _reduce(pending))

    def describe(self) -> str:
        """Name the solver."""
        return "Least squares by QR."


def _reduce(parts: list[Tensor]) -> Tensor:
    stacked = torch.cat(parts)
    if not bool(torch.isfinite(stacked).all()):
        return stacked[:0]
    reduced: Tensor = torch.linalg.qr(stacked, mode="r").R
    return reduced
