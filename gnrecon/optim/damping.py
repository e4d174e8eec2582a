"""Levenberg-Marquardt: the damping follows the gain ratio, and the step may bend with the residuals.

*Gain ratio.* The loss's true decrease over the one that the linear model predicts. A step is taken when it improves, and
the damping follows Nielsen's smooth rule, damping *= max(1/3, 1 - (2 gain - 1)^3), rising by growing factors while
trials fail. Source: Madsen, Nielsen, Tingleff, Methods for Non-linear Least Squares Problems (2004), section 3.2.

*Geodesic acceleration.* Along theta + t s the residuals leave their linear model by t^2 r_ss / 2, their second
derivative along s. The step that undoes this within the model solves the same system for r_ss in the place of r, and
half of that solution a is added:  s + a / 2. r_ss comes from one more evaluation,
2 / h ((r(theta + h s) - r(theta)) / h - J s). A trial with |a|_D > 3/4 |s|_D is refused, because the step is then longer
than the model can follow. In the long, bent valleys of sine networks this halves the steps (docs/solvers.md).
Source: Transtrum and Sethna, Improvements to the Levenberg-Marquardt algorithm for nonlinear least-squares
minimization (2012).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from torch import Tensor

from gnrecon.linalg.metric import Metric, jacobian_scaled
from gnrecon.linalg.system import DampedSystem, Step
from gnrecon.optim.problem import Problem
from gnrecon.optim.search import Move

PROBE = 0.1
BENT = 0.75


@dataclass(frozen=True)
class GainRatioDamping:
    """Levenberg-Marquardt; a rejected trial reuses the linearisation.

    Parameters
    ----------
    initial_damping : of the first step
    metric : what the damping is measured in
    geodesic : whether steps bend with the residuals, at one more evaluation and solve a step
    smallest : least damping
    trials : rejected steps after which there is no move
    """

    initial_damping: float = 1e-3
    metric: Metric = jacobian_scaled
    geodesic: bool = False
    smallest: float = 1e-12
    trials: int = 10

    def advance(self, problem: Problem, system: DampedSystem, free: Tensor, damping: float) -> Move:
        """Raise the damping until a step improves the loss."""
        start, growth, gain, iterations, failure = damping, 2.0, 0.0, 0, None
        for _ in range(self.trials):
            step = system.solve(damping)
            iterations += step.iterations
            failure = step.failure
            direction = self._direction(problem, system, free, damping, step)
            if direction is not None:
                trial = free + direction
                residual = problem.residual(trial)
                loss = 0.5 * float(residual @ residual)
                gain = (system.loss - loss) / step.predicted
                if math.isfinite(loss) and gain > 0.0:
                    easing = max(1 / 3, 1 - (2 * min(gain, 1.0) - 1) ** 3)
                    following = max(damping * easing, self.smallest)
                    return Move(trial, loss, damping, gain, 1.0, following, iterations)
            damping *= growth
            growth *= 2.0
        # Nothing helped here; the next step, with points of its own, begins not much above where this one did.
        return Move(free, system.loss, damping, gain, 0.0, start * 10, iterations, failure)

    def _direction(
        self, problem: Problem, system: DampedSystem, free: Tensor, damping: float, step: Step
    ) -> Tensor | None:
        """Return s, or s + a / 2; None where there is no step or it bends too much."""
        if not step.predicted > 0.0:
            return None
        s, equations = step.direction, system.equations
        if not self.geodesic:
            return s.to(free.dtype)
        there = problem.residual(free + PROBE * s.to(free.dtype)).to(s.dtype)
        bend = 2 / PROBE * ((there - equations.residual) / PROBE - equations.jacobian.mv(s))
        a = system.solve(damping, bend).direction
        # |a|_D > 3/4 |s|_D
        metric = equations.metric
        if not float(metric @ a.square()) <= BENT**2 * float(metric @ s.square()):
            return None
        return (s + a / 2).to(free.dtype)
