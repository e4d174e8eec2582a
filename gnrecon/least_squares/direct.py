"""Dense normal equations by Cholesky: one symmetric rank-k update, then a factorisation for each damping."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from gnrecon.least_squares.blocked_cholesky import lower_factor
from gnrecon.least_squares.jacobian import Jacobian
from gnrecon.least_squares.system import Equations, Linearisation, Metric, Step


@dataclass(frozen=True)
class NormalSystem(Linearisation):
    """J^T J, in its lower triangle, which is left unchanged by `solve`; `stored` is the precision of J."""

    product: Tensor
    stored: torch.dtype = torch.float64

    def solve(self, damping: float, residual: Tensor | None = None) -> Step:
        """Return the exact step."""
        equations = self.equations.at(residual)
        obstacle = equations.obstacle(damping)
        if obstacle:
            return equations.failed(obstacle)
        factor = self._factor(damping, lambda: self._damped(damping))
        if factor is None:
            return equations.indefinite()
        return equations.step(solve_factored(factor, -equations.gradient), damping)

    def _damped(self, damping: float) -> Tensor | None:
        """Return the factor, in single precision where J^T J has been rounded to it and the damping hides that."""
        diagonal = damping * self.equations.metric
        factor = rounded_factor(self.product, diagonal, self.stored)
        return damped_factor(self.product, diagonal) if factor is None else factor


@dataclass(frozen=True)
class Cholesky:
    """Dense normal equations: O(M p^2) to linearise, O(p^3) a damping, p^2 numbers of memory.

    It squares the condition number of J, so that in float64 dampings below about 1e-14 of J^T J's largest eigenvalue
    are lost in rounding; see `QR`.
    """

    def linearise(self, jacobian: Jacobian, residual: Tensor, metric: Metric) -> NormalSystem:
        """Assemble J^T J."""
        return NormalSystem(Equations.of(jacobian, residual, metric), jacobian.gram(), jacobian.stored)

    def describe(self) -> str:
        """Name the solver."""
        return "Dense normal equations by Cholesky."


def damped_factor(product: Tensor, diagonal: Tensor, overwrite: bool = False) -> Tensor | None:
    """Return the Cholesky factor of `product` + diag(`diagonal`), or None where that is not positive definite.

    The lower triangles of both matrices are valid. With `overwrite`, `product` is changed in place, which saves a copy.
    """
    damped = product if overwrite else product.clone()
    damped.diagonal().add_(diagonal)
    return lower_factor(damped)


def rounded_factor(product: Tensor, diagonal: Tensor, stored: torch.dtype) -> Tensor | None:
    """Return that factor in single precision, or None where J is not `stored` so or the damping does not hide it."""
    if stored != torch.float32:
        return None
    return damped_factor(product.to(torch.float32, copy=True), diagonal.float(), overwrite=True)


def solve_factored(factor: Tensor, right: Tensor) -> Tensor:
    """Return (L L^T)^-1 b for b of shape (p,), computed in the precision of the factor."""
    # Two triangular solves: torch.cholesky_solve is about twenty times slower for one right-hand side.
    half = torch.linalg.solve_triangular(factor, right.to(factor)[:, None], upper=False)
    solution: Tensor = torch.linalg.solve_triangular(factor.T, half, upper=True)
    return solution[:, 0].to(right)


# Least squares by QR, without squaring the condition number.
#
# J = Q R is reduced chunk by chunk: R <- qr([R; chunk]), with the residual as one more column, which gives Q^T r.
# J is never stored. For each damping, [R; sqrt(damping D)] is reduced once more; its R' gives R'^T R' =
# J^T J + damping D, and R' s = -Q'^T (Q^T r, 0). Source: Demmel, Grigori, Hoemmen, Langou, Communication-optimal
# parallel and sequential QR (2012); the paper solves its normal equations by QR as well, on the square matrix J^T J +
# damping I.


@dataclass(frozen=True)
class ReducedSystem(Linearisation):
    """The matrix [R, Q^T r], of shape (min(M, p + 1), p + 1)."""

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
        # A column that is linearly dependent on those before it leaves a zero, up to rounding, on the diagonal.
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


# The push-through (Woodbury) form: solve in the space of residuals, where the system is M by M.
#
#     (J^T J + damping D)^-1 J^T r = D^-1 J^T (J D^-1 J^T + damping I)^-1 r.
#
# K = J D^-1 J^T is formed from layer Gram matrices by Hadamard products (`Jacobian.kernel`), J itself never; one
# eigendecomposition or, as here, one Cholesky factorisation of size M a damping. Source: the paper's section on scaling
# via the Woodbury identity. For the kernel to have this form D must be constant on each group of columns, which the
# identity and the layer-scaled metric are.


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
            return equations.indefinite()
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


# Normal equations with a matrix averaged over steps, for points that are resampled at each step.
#
# If there are few more rows than parameters, J^T J of one sample is nearly singular, and steps along its null space
# become too long. The expected matrix changes little from step to step, so the mean over the last few steps is as good
# as that of several times as many rows, at no cost. The gradient is that of the current rows.
#
# Source: the averaged curvature of stochastic natural-gradient methods, such as Martens and Grosse, Optimizing neural
# networks with Kronecker-factored approximate curvature (2015), section 5.


@dataclass
class Averaged:
    """Dense normal equations by Cholesky, the matrix averaged.

    Parameters
    ----------
    keep : weight of the previous mean in the new one, below 1; the first steps have equal weights
    """

    keep: float = 0.8
    _mean: Tensor | None = field(default=None, init=False, repr=False)
    _steps: int = field(default=0, init=False, repr=False)

    def linearise(self, jacobian: Jacobian, residual: Tensor, metric: Metric) -> NormalSystem:
        """Assemble J^T J and update the mean."""
        product = jacobian.gram()
        if self._mean is None or self._mean.shape != product.shape:
            self._mean, self._steps = product, 0
        self._steps += 1
        self._mean = product.lerp(self._mean, min(self.keep, 1 - 1 / self._steps))
        return NormalSystem(Equations.of(jacobian, residual, metric), self._mean)

    def describe(self) -> str:
        """Name the solver."""
        return "Dense normal equations by Cholesky, averaged over steps."
