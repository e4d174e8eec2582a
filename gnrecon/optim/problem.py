"""What the optimisers ask of a nonlinear least-squares problem; they know nothing else of it."""

from __future__ import annotations

from typing import Protocol

from torch import Tensor

from gnrecon.linalg.jacobian import Jacobian


class Problem(Protocol):
    """Residuals r on one frozen set of points, as a function of the free ones of the parameters theta.

    The loss is |r|^2 / 2. Which parameters are free may differ from step to step.
    """

    def free(self) -> Tensor:
        """Return the free parameters, of shape (k,), where the problem was posed."""
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


def loss_of(problem: Problem, free: Tensor) -> float:
    """Return |r|^2 / 2."""
    residual = problem.residual(free)
    return 0.5 * float(residual @ residual)
