"""Plain nonlinear least-squares problems, none of which is a shape, for the optimisers' tests."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.autograd.functional import jacobian

from gnrecon.least_squares import DenseJacobian

Formula = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class Plain:
    """Residuals given as a formula, differentiated automatically; `chosen` are the free parameters, if not all."""

    formula: Formula
    theta: Tensor
    chosen: Tensor | None = None

    def free(self) -> Tensor:
        return self.theta if self.chosen is None else self.theta[self.chosen]

    def whole(self, free: Tensor) -> Tensor:
        return free if self.chosen is None else self.theta.index_copy(0, self.chosen, free)

    def residual(self, free: Tensor) -> Tensor:
        return self.formula(self.whole(free))

    def linearise(self, free: Tensor) -> tuple[DenseJacobian, Tensor]:
        return DenseJacobian(jacobian(self.residual, free, vectorize=True), chunk=3), self.residual(free)


@dataclass(frozen=True)
class Case:
    """A formula, a start and the minimum, reached within `tolerance` of each parameter."""

    formula: Formula
    start: tuple[float, ...]
    minimum: tuple[float, ...]
    tolerance: float = 1e-5

    def at(self, number: int, theta: Tensor) -> Plain:
        del number
        return Plain(self.formula, theta)

    @property
    def theta(self) -> Tensor:
        return torch.tensor(self.start, dtype=torch.float64)

    @property
    def best(self) -> Tensor:
        return torch.tensor(self.minimum, dtype=torch.float64)


def rosenbrock(theta: Tensor) -> Tensor:
    x, y = theta
    return torch.stack([10 * (y - x**2), 1 - x])


def powell_singular(theta: Tensor) -> Tensor:
    """Its Jacobian is singular at the minimum, so that Gauss-Newton converges linearly only."""
    a, b, c, d = theta
    return torch.stack([a + 10 * b, 5**0.5 * (c - d), (b - 2 * c) ** 2, 10**0.5 * (a - d) ** 2])


TIMES = torch.linspace(0, 4, 21, dtype=torch.float64)


def decay(theta: Tensor) -> Tensor:
    return theta[0] * torch.exp(-theta[1] * TIMES) + theta[2]


def exponential_fit(theta: Tensor) -> Tensor:
    return decay(theta) - decay(torch.tensor([2.0, 0.7, -0.3], dtype=torch.float64))


def circle_fit(theta: Tensor) -> Tensor:
    """Five points that lie on no circle, symmetric about both axes, so that the least squares' centre is known."""
    points = torch.tensor([[2, 0], [-2, 0], [0, 1], [0, -1], [0, 0]], dtype=torch.float64)
    return torch.cat([(points[:4] - theta).square().sum(1) - 2.5, points[4:, 0]])


CASES = {
    "rosenbrock": Case(rosenbrock, (-1.2, 1.0), (1.0, 1.0)),
    "powell singular": Case(powell_singular, (3.0, -1.0, 0.0, 1.0), (0.0, 0.0, 0.0, 0.0), 2e-3),
    "exponential fit": Case(exponential_fit, (1.0, 0.2, 0.0), (2.0, 0.7, -0.3)),
    "circle, residual left": Case(circle_fit, (0.7, 0.4), (0.0, 0.0)),
}
