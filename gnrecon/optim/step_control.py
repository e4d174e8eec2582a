"""Levenberg-Marquardt: the damping follows the gain ratio, optionally with geodesic acceleration.

*Gain ratio.* The actual decrease of the loss over the decrease that the linear model predicts. A step that decreases
the loss is accepted, and the damping follows Nielsen's rule, damping *= max(1/3, 1 - (2 gain - 1)^3); it rises by
growing factors while trials fail. Source: Madsen, Nielsen, Tingleff, Methods for Non-linear Least Squares Problems
(2004), section 3.2.

*Geodesic acceleration.* Along theta + t s the residuals leave their linear model by t^2 r_ss / 2, their second
derivative along s. The step that compensates for this within the model solves the same system with r_ss in place of r,
and half of that solution a is added:  s + a / 2. r_ss takes one more evaluation,
2 / h ((r(theta + h s) - r(theta)) / h - J s). A step with |a|_D > 3/4 |s|_D is longer than the range of the model. In
the long, curved valleys of sine networks this halves the number of steps (docs/research/2026-11-21-step-control.md).
Source: Transtrum and Sethna, Improvements to the Levenberg-Marquardt algorithm for nonlinear least-squares
minimization (2012).

*Shorter steps.* Where a network has thousands of parameters, to solve again with a larger damping takes many times as
long as to evaluate the loss. A trial may then go along the curve  theta + t s + t^2 a / 2  as far as the model's
range, t = 3/4 |s|_D / |a|_D, where the criterion holds for t s and t^2 a. Where the loss has risen, the minimum of the
parabola through its value and slope at the start and its new value is tried once, before the damping rises. Such a step
gains a little less than a damped one. Source: Nocedal and Wright, Numerical Optimization (2006), section 3.5, for the
parabola and its bounds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import torch
from torch import Tensor

from gnrecon.least_squares.system import DampedSystem, Metric, Step, identity, jacobian_scaled
from gnrecon.optim.problem import Problem, loss_of


@dataclass(frozen=True)
class GainRatioDamping:
    """Levenberg-Marquardt; a rejected trial reuses the linearisation.

    Parameters
    ----------
    initial_damping : of the first step
    metric : what the damping is measured in
    geodesic : whether to add the geodesic acceleration, at one more evaluation and solve per step
    length : fraction of an accepted step that is taken; if points are resampled at each step and the residuals do not
        vanish at the minimum, shorter steps average over more samples
    smallest : least damping
    trials : dampings after which the parameters stay
    growth : factor of the damping after a first trial that is rejected, and after a step that had to be shorter
    least_share : share down to which a step may be shortened before the damping rises; at 1 no step is
    """

    initial_damping: float = 1e-3
    metric: Metric = jacobian_scaled
    geodesic: bool = False
    length: float = 1.0
    smallest: float = 1e-12
    trials: int = 10
    growth: float = 2.0
    least_share: float = 1.0

    def advance(self, problem: Problem, system: DampedSystem, free: Tensor, damping: float) -> Move:
        """Raise the damping until a step, or the part of it within the model's range, decreases the loss."""
        start, growth, gain, iterations, failure = damping, self.growth, 0.0, 0, None
        for _ in range(self.trials):
            step = system.solve(damping)
            acceleration = self._acceleration(problem, system, free, damping, step)
            iterations += step.iterations + acceleration.iterations
            failure = step.failure
            if step.predicted > 0.0:
                curve = _Curve(free, step, acceleration, system)
                share, loss, gain = self._lowered(problem, curve)
                if gain > 0.0:
                    easing = max(1 / 3, 1 - (2 * min(gain, 1.0) - 1) ** 3) if share == 1.0 else self.growth
                    trial = curve.at(share)
                    if self.length < 1.0:
                        trial = free + self.length * (trial - free)
                        loss = loss_of(problem, trial)
                    following = max(damping * easing, self.smallest)
                    return Move(trial, loss, damping, gain, self.length * share, following, iterations)
            damping *= growth
            growth *= 2.0
        # No trial decreased the loss; the next step, with other points, starts ten times as damped as this one did.
        return Move(free, system.loss, damping, gain, 0.0, start * 10, iterations, failure)

    def _lowered(self, problem: Problem, curve: _Curve) -> tuple[float, float, float]:
        """Return a share of a step, the loss there, and its gain ratio, which is not positive if the loss has risen."""
        share, loss, gain = curve.range, math.inf, 0.0
        for _ in range(2):
            if share < self.least_share:
                break
            loss = loss_of(problem, curve.at(share))
            gain = (curve.system.loss - loss) / curve.predicted(share) if math.isfinite(loss) else 0.0
            if gain > 0.0:
                break
            share = curve.shorter(share, loss)
        return share, loss, gain

    def _acceleration(
        self,
        problem: Problem,
        system: DampedSystem,
        free: Tensor,
        damping: float,
        step: Step,
        *,
        probe_length: float = 0.1,
    ) -> Step:
        """Return a, or zero without geodesic acceleration or without a step.

        `probe_length` is h, as a fraction of the step; Transtrum and Sethna recommend 0.1.
        """
        s = step.direction
        if not self.geodesic or not step.predicted > 0.0:
            return Step(torch.zeros_like(s), 0.0)
        J, r = system.equations.jacobian, system.equations.residual
        ahead = problem.residual(free + probe_length * s.to(free.dtype)).to(r)
        # r_ss from r(theta + h s) = r + h J s + h^2 r_ss / 2
        return system.solve(damping, 2 / probe_length * ((ahead - r) / probe_length - J.mv(s)))

    def describe(self) -> str:
        """Name the search."""
        return f"Gauss-Newton with gain-ratio damping{' and geodesic acceleration' if self.geodesic else ''}."


@dataclass(frozen=True)
class _Curve:
    """theta + t s + t^2 a / 2 for a step s and its acceleration a, in the free parameters theta, of shape (k,)."""

    free: Tensor
    step: Step
    acceleration: Step
    system: DampedSystem

    def at(self, share: float) -> Tensor:
        """Return the parameters at t."""
        return self.free + (share * self.step.direction + share**2 / 2 * self.acceleration.direction).to(self.free)

    @cached_property
    def slope(self) -> float:
        """The derivative of the loss by t at the start."""
        return float(self.step.direction @ self.system.equations.gradient)

    def predicted(self, share: float) -> float:
        """Return the decrease of the loss in the linear model, -t g.s - t^2 |J s|^2 / 2."""
        return share**2 * self.step.predicted - (share - share**2) * self.slope

    @cached_property
    def range(self, *, largest_ratio: float = 0.75) -> float:
        """The largest t up to one with |t^2 a|_D <= 3/4 |t s|_D, the acceptance criterion of Transtrum and Sethna."""
        metric = self.system.equations.metric
        squares = [float(metric @ part.direction.square()) for part in (self.step, self.acceleration)]
        bends = largest_ratio**2 * squares[0] < squares[1]
        return largest_ratio * math.sqrt(squares[0] / squares[1]) if bends else 1.0

    def shorter(self, share: float, loss: float) -> float:
        """Return where the parabola through the loss and its slope at the start, and a larger loss at t, is least.

        It is a tenth to a half of t; 0 where there is no such parabola, as the loss is not finite.
        """
        bend = loss - self.system.loss - share * self.slope
        return share * min(max(-share * self.slope / (2 * bend), 0.1), 0.5) if 0.0 < bend < math.inf else 0.0


# Lengths along one direction: the paper's log-spaced line search, and a fixed multiple.
#
# The direction has a tiny fixed damping, so it is the natural gradient in the paper's function space. *Log-spaced*:
# lengths spaced evenly in the logarithm are all tried from the same start, and the best is taken. *Fixed*: the same
# multiple at each step, as in the paper on resampled moving surfaces, where losses of different samples cannot be
# compared.


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
        # At a stationary point no decrease is predicted, and any decrease is rounding.
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
    """Fixed damping, and `length` times the direction, even if the loss increases, as long as it stays finite."""

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


@dataclass(frozen=True)
class Move:
    """The result of a step control: new free parameters and loss (the old ones if `length` is zero), and next damping.

    `iterations` counts those of iterative solvers; `failure` says why a solver found no step, if it did not.
    """

    free: Tensor
    loss: float
    damping: float
    gain_ratio: float
    length: float
    next_damping: float
    iterations: int = 0
    failure: str | None = None


class Search(Protocol):
    """A step control: chooses a step from a damped system."""

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

    def describe(self) -> str:
        """Return a description of the method, in a sentence."""
        ...
