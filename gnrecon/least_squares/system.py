"""The interface of linear solvers: linearise once, then solve for any number of dampings.

A Gauss-Newton step minimises |r + J s|^2 + damping |s|_D^2, so that  (J^T J + damping D) s = -g  with g = J^T r. Its
predicted decrease of the loss |r|^2 / 2 is  -s.g - |J s|^2 / 2. With the residual of the solve, rho = -g - (J^T J +
damping D) s, it equals (damping |s|_D^2 - s.g + s.rho) / 2, which avoids cancellation and needs no product with J.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Protocol

import torch
from torch import Tensor

from gnrecon.least_squares.jacobian import Jacobian


@dataclass(frozen=True)
class Step:
    """A damped step, of shape (p,), and the decrease of the loss that the linear model predicts for it.

    If there is no step, `failure` says why in a sentence, and the direction is zero.
    """

    direction: Tensor
    predicted: float
    iterations: int = 0
    failure: str | None = None


class DampedSystem(Protocol):
    """One linearisation."""

    @property
    def equations(self) -> Equations:
        """J, r, g = J^T r and D."""
        ...

    @property
    def loss(self) -> float:
        """|r|^2 / 2."""
        ...

    def solve(self, damping: float, residual: Tensor | None = None) -> Step:
        """Return the step for a damping, with other residuals, of shape (M,), in place of r if given.

        It does not raise if there is no solution; see `Step.failure`.
        """
        ...


class LinearSolver(Protocol):
    """A way of solving damped systems."""

    def linearise(self, jacobian: Jacobian, residual: Tensor, metric: Metric) -> DampedSystem:
        """Return the system of J and r, of shape (M,), damped in a metric."""
        ...

    def describe(self) -> str:
        """Return the name of the method, and why it was chosen if it was, in a sentence."""
        ...


@dataclass(frozen=True)
class Equations:
    """The data of a system, J, r, g and D, and the conversion of a solution to a step."""

    jacobian: Jacobian
    residual: Tensor
    gradient: Tensor
    metric: Tensor

    @classmethod
    def of(cls, jacobian: Jacobian, residual: Tensor, metric: Metric) -> Equations:
        """Return the common part of a system.

        Raises
        ------
        ValueError
            When J and r have different numbers of rows.
        """
        if residual.shape != (jacobian.rows,):
            raise ValueError(f"There are {jacobian.rows} rows, but residuals of shape {tuple(residual.shape)}.")
        residual = residual.to(jacobian.dtype)
        return cls(jacobian, residual, jacobian.tmv(residual), metric(jacobian))

    def at(self, residual: Tensor | None) -> Equations:
        """Return the same equations for other residuals, of shape (M,), or themselves if there are none."""
        if residual is None:
            return self
        residual = residual.to(self.residual)
        return replace(self, residual=residual, gradient=self.jacobian.tmv(residual))

    def obstacle(self, damping: float) -> str | None:
        """Return why no solver can find a step, or None."""
        if self.jacobian.rows == 0:
            return "There are no residuals to lower."
        if self.gradient.numel() == 0:
            return "There are no free parameters."
        if not bool(torch.isfinite(self.gradient).all()) or not bool(torch.isfinite(self.metric).all()):
            return "The Jacobian or the residuals are not finite."
        if not damping >= 0.0:
            return f"The damping must not be negative, not {damping}."
        return None

    def step(self, solution: Tensor, damping: float, rest: Tensor | None = None, iterations: int = 0) -> Step:
        """Return the step of a solution, of shape (p,), with the residual `rest` (rho, by default 0)."""
        if not bool(torch.isfinite(solution).all()):
            return self.failed("The solution is not finite.")
        twice = damping * (self.metric * solution) @ solution - solution @ self.gradient
        if rest is not None:
            twice = twice + solution @ rest
        return Step(solution, 0.5 * float(twice), iterations)

    def indefinite(self) -> Step:
        """Return a zero step for a damped matrix without a Cholesky factor."""
        return self.failed("The damped matrix is not positive definite; a larger damping may help.")

    def failed(self, sentence: str, iterations: int = 0) -> Step:
        """Return a zero step with the reason."""
        return Step(torch.zeros_like(self.gradient), 0.0, iterations, sentence)


@dataclass(frozen=True)
class Linearisation:
    """The base of the solvers' systems.

    The factor of the last damping is cached, for other residuals at the same damping.
    """

    equations: Equations
    _last: dict[float, Tensor | None] = field(default_factory=dict, init=False, repr=False, compare=False)

    @cached_property
    def loss(self) -> float:
        """|r|^2 / 2."""
        return 0.5 * float(self.equations.residual @ self.equations.residual)

    def _factor(self, damping: float, make: Callable[[], Tensor | None]) -> Tensor | None:
        if damping not in self._last:
            self._last.clear()
            self._last[damping] = make()
        return self._last[damping]


Metric = Callable[[Jacobian], Tensor]
"""Returns the diagonal of D, of shape (p,), all positive."""

# Diagonal metrics D of the parameters, in which the damping is measured: a damped step minimises
# |r + J s|^2 + damping |s|_D^2  with  |s|_D^2 = s.D s.


def identity(jacobian: Jacobian) -> Tensor:
    """Damp all parameters equally (Levenberg), as the paper does."""
    return torch.ones(jacobian.columns, dtype=jacobian.dtype, device=jacobian.device)


def jacobian_scaled(jacobian: Jacobian) -> Tensor:
    """Damp in units of J^T J's diagonal (Marquardt), with a floor for parameters that no residual depends on."""
    diagonal = jacobian.diagonal()
    return _bounded(diagonal)


def layer_scaled(jacobian: Jacobian) -> Tensor:
    """Damp each layer in units of the mean of its part of J^T J's diagonal, with a floor as above.

    The sensitivity of the field differs by orders of magnitude between layers, but not within a layer.
    """
    return _bounded(_layer_means(jacobian, jacobian.diagonal()))


def jacobian_layer_scaled(jacobian: Jacobian, *, layer_share: float = 0.1) -> Tensor:
    """Damp in units of J^T J's diagonal plus `layer_share` times the mean over the layer.

    With the diagonal alone, parameters to which the residuals are not yet sensitive move beyond the range of the linear
    model, and the damping must rise for all; with layer means alone, late steps are shorter. The share is measured, see
    docs/research/2026-11-23-learning-scans.md.
    """
    diagonal = jacobian.diagonal()
    return _bounded(diagonal + layer_share * _layer_means(jacobian, diagonal))


def _layer_means(jacobian: Jacobian, diagonal: Tensor) -> Tensor:
    """Return the mean of its layer's part of the diagonal for each parameter, of shape (p,)."""
    means = torch.ones_like(diagonal)
    for group in jacobian.groups:
        if group.stop > group.start:
            means[group] = diagonal[group].mean()
    return means


def _bounded(diagonal: Tensor) -> Tensor:
    if not diagonal.numel():
        return diagonal
    return diagonal.clamp_min(1e-12 * float(diagonal.max()) + torch.finfo(diagonal.dtype).tiny)
