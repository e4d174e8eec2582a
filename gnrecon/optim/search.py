"""How long a step to take: two ways to globalise Gauss-Newton, behind one interface.

*Gain-ratio damping* (Levenberg-Marquardt): the gain ratio compares the loss's true decrease with the linear model's
predicted one; a step is taken when it improves, and the damping follows Nielsen's smooth rule,
damping *= max(1/3, 1 - (2 gain - 1)^3), rising by growing factors while trials fail.
Source: Madsen, Nielsen, Tingleff, Methods for Non-linear Least Squares Problems (2004), section 3.2.

*Log-spaced line search* (the paper): the direction has a tiny fixed damping, and lengths spaced evenly in their
logarithm are all tried from the same start; the best one is taken. Nothing is kept of a trial that lost.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from gnrecon.linalg.damped import DampedSystem, Metric, identity, jacobian_scaled
from gnrecon.optim.problem import Problem, loss_of


@dataclass(frozen=True)
class Move:
    """Where a search ended: new free parameters and loss (the old ones when `length` is zero), and the next damping."""

    free: Tensor
    loss: float
    damping: float
    gain_ratio: float
    length: float
    next_damping: float


class Search(Protocol):
    """Turns a damped system into a move."""

    @property
    def initial_damping(self) -> float:
        """Damping of the first step."""
        ...

    @property
    def metric(self) -> Metric:
        """What the damping is measured in."""
        ...

    def advance(self, problem: Problem, system: DampedSystem, free: Tensor, damping: float) -> Move:
        """Return the move from the free parameters, of shape (k,)."""
        ...


@dataclass(frozen=True)
class GainRatioDamping:
    """Levenberg-Marquardt; a rejected trial reuses the assembled system."""

    initial_damping: float = 1e-3
    metric: Metric = jacobian_scaled
    smallest: float = 1e-12
    trials: int = 10

    def advance(self, problem: Problem, system: DampedSystem, free: Tensor, damping: float) -> Move:
        """Raise the damping until a step improves the loss."""
        start, growth, gain = damping, 2.0, 0.0
        for _ in range(self.trials):
            step = system.solve(damping)
            if step is not None and step.predicted > 0.0:
                trial = free + step.direction
                loss = loss_of(problem, trial)
                gain = (system.loss - loss) / step.predicted
                if math.isfinite(loss) and gain > 0.0:
                    easing = max(1 / 3, 1 - (2 * min(gain, 1.0) - 1) ** 3)
                    return Move(trial, loss, damping, gain, 1.0, max(damping * easing, self.smallest))
            damping *= growth
            growth *= 2.0
        # Nothing helped here; the next step, with points of its own, begins not much above where this one did.
        return Move(free, system.loss, damping, gain, 0.0, start * 10)


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
        if step is None or step.predicted <= 0.0:
            return Move(free, system.loss, damping, 0.0, 0.0, damping * 10)
        best = Move(free, system.loss, damping, 0.0, 0.0, self.initial_damping)
        for trial in range(self.trials):
            length = self.shortest ** (trial / (self.trials - 1))
            moved = free + length * step.direction
            loss = loss_of(problem, moved)
            if loss < best.loss:
                gain = (system.loss - loss) / step.predicted
                best = Move(moved, loss, damping, gain, length, self.initial_damping)
        return best
