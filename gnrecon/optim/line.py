"""Lengths along one direction: the paper's log-spaced line search, and a fixed multiple.

The direction has a tiny fixed damping, so that it is the natural gradient of the paper's function space. *Log-spaced*:
lengths spaced evenly in their logarithm are all tried from the same start, and the best one is taken; nothing is kept
of a trial that lost. *Fixed*: the same multiple each step, as the paper steps on resampled moving surfaces, where
losses of different samples do not compare.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from torch import Tensor

from gnrecon.linalg.metric import Metric, identity
from gnrecon.linalg.system import DampedSystem
from gnrecon.optim.problem import Problem, loss_of
from gnrecon.optim.search import Move


@dataclass(frozen=True)
class LogLineSearch:
    """Fixed tiny damping, and the best of `trials` lengths from 1 down to `shortest`, evenly spaced in log."""

    initial_damping: float = 1e-6
    metric: Metric = identity
    trials: int = 15
    shortest: float = 2.0**-14

    def advance(self, problem: Problem, system: DampedSystem, free: Tensor, damping: float) -> Move:
        """Try all lengths along one direction, each from the same start."""
        step = system.solve(damping)
        # At a stationary point nothing is predicted, and what the loss falls by is rounding.
        if step.predicted <= 0.0:
            return Move(free, system.loss, damping, 0.0, 0.0, damping * 10, step.iterations, step.failure)
        best = Move(free, system.loss, damping, 0.0, 0.0, self.initial_damping, step.iterations)
        for trial in range(self.trials):
            length = self.shortest ** (trial / max(self.trials - 1, 1))
            moved = free + length * step.direction.to(free.dtype)
            loss = loss_of(problem, moved)
            if loss < best.loss:
                gain = (system.loss - loss) / step.predicted
                best = Move(moved, loss, damping, gain, length, self.initial_damping, step.iterations)
        return best

    def describe(self) -> str:
        """Name the search."""
        return f"Gauss-Newton with a log-spaced line search, {self.trials} lengths."


@dataclass(frozen=True)
class FixedStep:
    """Fixed damping, and `length` times the direction, whatever it does to the loss as long as that stays finite."""

    length: float = 0.1
    initial_damping: float = 1e-6
    metric: Metric = identity

    def advance(self, problem: Problem, system: DampedSystem, free: Tensor, damping: float) -> Move:
        """Take the step."""
        step = system.solve(damping)
        moved = free + self.length * step.direction.to(free.dtype)
        loss = loss_of(problem, moved)
        if step.predicted <= 0.0 or not math.isfinite(loss):
            return Move(free, system.loss, damping, 0.0, 0.0, damping * 10, step.iterations, step.failure)
        gain = (system.loss - loss) / step.predicted
        return Move(moved, loss, damping, gain, self.length, self.initial_damping, step.iterations)

    def describe(self) -> str:
        """Name the search."""
        return f"Gauss-Newton with steps of {self.length:g} times the direction."
