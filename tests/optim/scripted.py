"""A problem that notes down what it was asked for, and whose losses may follow a script."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch
from least_squares_problems import CASES, Formula, Plain, rosenbrock
from torch import Tensor

from gnrecon.least_squares import Cholesky, DampedSystem, DenseJacobian
from gnrecon.optim import Search


@dataclass
class Scripted:
    """A problem, the places where its residuals were asked for, and losses to give there in order, if there are any."""

    inner: Plain
    script: list[float] = field(default_factory=list)
    asked: list[Tensor] = field(default_factory=list)

    def free(self) -> Tensor:
        return self.inner.free()

    def whole(self, free: Tensor) -> Tensor:
        return self.inner.whole(free)

    def residual(self, free: Tensor) -> Tensor:
        self.asked.append(free.clone())
        if self.script:
            return torch.tensor([math.sqrt(2 * self.script[len(self.asked) - 1])], dtype=free.dtype)
        return self.inner.residual(free)

    def linearise(self, free: Tensor) -> tuple[DenseJacobian, Tensor]:
        return self.inner.linearise(free)


def posed(
    search: Search, script: list[float] | None = None, formula: Formula = rosenbrock
) -> tuple[Scripted, DampedSystem, Tensor]:
    """A problem at the start of the rosenbrock case, its system and its parameters."""
    theta = CASES["rosenbrock"].theta
    problem = Scripted(Plain(formula, theta), script or [])
    return problem, Cholesky().linearise(*problem.linearise(theta), search.metric), theta
