"""The push-through (Woodbury) form: solve in the space of residuals, where the system is M by M.

    (J^T J + damping D)^-1 J^T r = D^-1 J^T (J D^-1 J^T + damping I)^-1 r.

K = J D^-1 J^T is formed from layer Gram matrices by Hadamard products (`Jacobian.kernel`), J itself never; one
eigendecomposition or, as here, one Cholesky factorisation of size M a damping. Source: the paper's section on scaling
via the Woodbury identity. For the kernel to have this form D must be constant on each group of columns, which the
identity and the layer-scaled metric are.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gnrecon.linalg.cholesky import INDEFINITE, damped_factor, solve_factored
from gnrecon.linalg.jacobian import Jacobian
from gnrecon.linalg.metric import Metric
from gnrecon.linalg.system import Equations, Linearisation, Step


@dataclass(frozen=True)
class RowSystem(Linearisation):
    """K = J D^-1 J^T, in its lower triangle."""

    kernel: Tensor

    def solve(self, damping: float, residual: Tensor | None = None) -> Step:
        """Return the exact step; a damping of zero needs rows that do not depend on each other."""
        equations = self.equations.at(residual)
        obstacle = equations.obstacle(damping)
        if obstacle:
            return equations.failed(obstacle)
        right = equations.residual
        factor = self._factor(damping, lambda: damped_factor(self.kernel, torch.full_like(right, damping)))
        if factor is None:
            return equations.failed(INDEFINITE)
        dual = solve_factored(factor, -right)
        return equations.step(equations.jacobian.tmv(dual) / equations.metric, damping)


@dataclass(frozen=True)
class RowSpace:
    """Push-through in row space: O(M^2 width) to linearise, O(M^3) a damping, M^2 numbers of memory."""

    def linearise(self, jacobian: Jacobian, residual: Tensor, metric: Metric) -> RowSystem:
        """Assemble K.

        Raises
        ------
        ValueError
            When the metric differs within a group of columns.
        """
        equations = Equations.of(jacobian, residual, metric)
        if not constant_on_groups(equations.metric, jacobian):
            raise ValueError("The kernel form needs a metric that is constant within each group of columns.")
        firsts = [equations.metric[group.start] if group.stop > group.start else 1.0 for group in jacobian.groups]
        scales = [1.0 / float(first) for first in firsts]
        return RowSystem(equations, jacobian.kernel(scales))

    def describe(self) -> str:
        """Name the solver."""
        return "Push-through (Woodbury) in row space, its kernel from layer Gram matrices."


def constant_on_groups(metric: Tensor, jacobian: Jacobian) -> bool:
    """Whether D, of shape (p,), is the same number in all columns of each group, or not finite."""
    if not bool(torch.isfinite(metric).all()):
        return True
    parts = [metric[group] for group in jacobian.groups if group.stop > group.start]
    return all(bool((part == part[0]).all()) for part in parts)
