"""The interface of a nonlinear least-squares problem, all that the optimisers use of it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import torch
from torch import Tensor

from gnrecon.least_squares.jacobian import Jacobian


class Problem(Protocol):
    """Residuals r on one frozen set of points, as a function of the free ones of the parameters theta.

    The loss is |r|^2 / 2. Which parameters are free may differ from step to step.
    """

    def free(self) -> Tensor:
        """Return the free parameters, of shape (k,), at which the problem was frozen."""
        ...

    def whole(self, free: Tensor) -> Tensor:
        """Return all parameters, of shape (p,)."""
        ...

    def residual(self, free: Tensor) -> Tensor:
        """Return r, of shape (M,), weights included."""
        ...

    def linearise(self, free: Tensor) -> tuple[Jacobian, Tensor]:
        """Return J, of shape (M, k), as an operator, and r, of shape (M,), weights included."""
        ...


ProblemAt = Callable[[int, Tensor], Problem]
"""Returns the frozen problem of an outer step from its number, from 1, and all current parameters, of shape (p,)."""


def loss_of(problem: Problem, free: Tensor) -> float:
    """Return |r|^2 / 2."""
    residual = problem.residual(free)
    return 0.5 * float(residual @ residual)


def loss_and_gradient(problem: Problem, free: Tensor) -> tuple[float, Tensor]:
    """Return |r|^2 / 2 and its gradient J^T r, of shape (k,), in the precision of the parameters."""
    jacobian, residual = problem.linearise(free)
    gradient = jacobian.tmv(residual.to(jacobian.dtype))
    return 0.5 * float(residual @ residual), gradient.to(free.dtype)


def places_of(problem: Problem) -> Tensor:
    """Return the indices of the free parameters in theta, of shape (k,)."""
    free = problem.free()
    # The difference between ones and zeros shows which parameters are free; distinct numbers show their order.
    chosen = (problem.whole(torch.ones_like(free)) - problem.whole(torch.zeros_like(free)) == 1.0).nonzero()[:, 0]
    numbers = torch.arange(len(free), dtype=torch.float64, device=free.device).to(free.dtype)
    places = torch.empty_like(chosen)
    places[problem.whole(numbers)[chosen].long()] = chosen
    return places
