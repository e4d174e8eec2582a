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
from gnrecon.linalg.system import Equations, Step


@dataclass(frozen=True)
class ReducedSystem:
    """R and Q^T r beside each other, of shape (min(M, p + 1), p + 1)."""

    reduced: Tensor
    equations: Equations

    @property
    def loss(self) -> float:
        """|r|^2 / 2."""
        return self.equations.loss

    @property
    def gradient(self) -> Tensor:
        """g = J^T r."""
        return self.equations.gradient

    def solve(self, damping: float) -> Step:
        """Return the exact step."""
        obstacle = self.equations.obstacle(damping)
        if obstacle:
            return self.equations.failed(obstacle)
        p = len(self.gradient)
        below = torch.cat([torch.diag((damping * self.equations.metric).sqrt()), self.reduced.new_zeros(p, 1)], 1)
        full = torch.linalg.qr(torch.cat([self.reduced, below]), mode="r").R
        diagonal = full.diagonal()[:p].abs()
        # A column that depends on those before it leaves a zero, or what rounding made of it, on the diagonal.
        lengths = torch.linalg.vector_norm(full[:, :p], dim=0)
        if not bool((diagonal > torch.finfo(full.dtype).eps * lengths).all()):
            return self.equations.failed("The damped matrix is singular; a larger damping may help.")
        step = torch.linalg.solve_triangular(full[:p, :p], -full[:p, p:], upper=True)[:, 0]
        return self.equations.step(step, damping)


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
        return ReducedSystem(_reduce(pending), equations)

    def describe(self) -> str:
        """Name the solver."""
        return "Least squares by QR."


def _reduce(parts: list[Tensor]) -> Tensor:
    stacked = torch.cat(parts)
    if not bool(torch.isfinite(stacked).all()):
        return stacked[:0]
    reduced: Tensor = torch.linalg.qr(stacked, mode="r").R
    return reduced
