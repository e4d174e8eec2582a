"""The interface of the optimisers and their common loop: freeze a problem, take a step, check the stopping rules.

The optimisers differ only in how they take an outer step. A loss that is not finite ends the run with the parameters
before it, and an interrupt (Ctrl-C) with those of the last finished step.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import Protocol

from torch import Tensor

from gnrecon.optim.problem import Problem, ProblemAt


class Optimiser(Protocol):
    """A way of minimising |r|^2 / 2."""

    def run(
        self,
        problem_at: ProblemAt,
        theta: Tensor,
        stop: StopRule,
        callback: Callback | None = None,
        held_out: ValidationLoss | None = None,
    ) -> Solution:
        """Minimise |r|^2 / 2 from theta, of shape (p,), which is left unchanged.

        Parameters
        ----------
        problem_at : gives the frozen problem of a step
        theta : starting parameters, of shape (p,)
        stop : when to stop
        callback : called with each step's record
        held_out : returns the loss of held-out residuals, which are not fitted, from all parameters; evaluated at the
            start and after each step; the parameters with the least value are returned
        """
        ...

    def describe(self) -> str:
        """Return a description of the method, in sentences."""
        ...


@dataclass(frozen=True)
class Outcome:
    """The result of an outer step: all parameters, of shape (p,), its record, and why the solver failed, if it did."""

    theta: Tensor
    record: Record
    failure: str | None = None


OuterStep = Callable[[int, Problem], Outcome]
"""Takes one outer step, from its number and its frozen problem."""


def iterate(take_step: OuterStep, problem_at: ProblemAt, monitor: RunMonitor, describe: Callable[[], str]) -> Solution:
    """Take steps until a stopping rule applies."""
    status = f"Stopped at the limit of {monitor.stop.steps} steps."
    try:
        monitor.start()
        for number in range(1, monitor.stop.steps + 1):
            outcome = take_step(number, problem_at(number, monitor.theta))
            if not math.isfinite(outcome.record.before) or not math.isfinite(outcome.record.loss):
                return monitor.solution(f"The loss was not finite at step {number}.", describe())
            ended = monitor.update(outcome.theta, outcome.record, outcome.failure)
            if ended is not None:
                return monitor.solution(ended, describe())
    except KeyboardInterrupt:
        return monitor.solution(f"Interrupted after {len(monitor.history)} steps.", describe(), interrupted=True)
    return monitor.solution(status, describe())


ValidationLoss = Callable[[Tensor], float]
"""Returns the loss of the held-out residuals from all parameters, of shape (p,)."""


# Stopping rules, checked after each outer step in this order:
#
#     idle       `patience` steps in a row each decreased the loss by less than the fraction `tolerance`
#     held-out   the loss of held-out residuals has not decreased by the fraction `tolerance` of its least value for
#                `held_out_patience` steps: the fit has begun to overfit
#     time       `seconds` have passed
#     limit      `steps` are done
#
# With held-out residuals, the parameters of their least loss, the start included, are returned whatever ends the run.
# Source: Prechelt, Early stopping - but when? (1998), the criterion of successive failures, with a threshold.


@dataclass(frozen=True)
class StopRule:
    """When to stop.

    Parameters
    ----------
    steps : most steps
    tolerance : relative decrease of a loss below which a step is idle
    patience : idle steps in a row after which the run has converged
    seconds : time after which no further step begins, or None for no limit
    held_out_patience : steps in a row without a decrease of the held-out residuals after which the run ends
    """

    steps: int = 50
    tolerance: float = 1e-3
    patience: int = 3
    seconds: float | None = None
    held_out_patience: int = 5


@dataclass
class BestParameters:
    """The parameters of the least held-out value so far.

    Parameters
    ----------
    theta, step, value : of the least value
    reference : the last value that was a decrease by the tolerance, with which the next ones are compared
    idle : steps since then
    """

    theta: Tensor
    step: int = 0
    value: float = math.inf
    reference: float = math.inf
    idle: int = 0

    def update(self, theta: Tensor, step: int, value: float, tolerance: float) -> None:
        """Compare the value at a step; until one is finite, the newest parameters are the best."""
        if value < self.value or math.isinf(self.value):
            self.theta, self.step = theta, step
        if value < self.value:
            self.value = value
        falls = value < (1 - tolerance) * self.reference
        self.reference, self.idle = (value, 0) if falls else (self.reference, self.idle + 1)


@dataclass
class RunMonitor:
    """The state of a run: its history, its parameters after the last finished step, and its stopping rules.

    Parameters
    ----------
    theta : starting parameters, of shape (p,)
    stop : the rules
    callback : called with each step's record
    held_out : returns the loss of the held-out residuals
    """

    theta: Tensor
    stop: StopRule
    callback: Callback | None = None
    held_out: ValidationLoss | None = None
    history: list[Record] = field(default_factory=list, init=False)
    idle: int = field(default=0, init=False)
    best: BestParameters | None = field(default=None, init=False)
    started: float = field(default_factory=perf_counter, init=False)

    def start(self) -> None:
        """Evaluate the held-out residuals at the start."""
        if self.held_out is not None:
            self.best = BestParameters(self.theta)
            value = self.held_out(self.theta)
            self.best.update(self.theta, 0, value, self.stop.tolerance)

    def update(self, theta: Tensor, record: Record, failure: str | None = None) -> str | None:
        """Add a finished step; return why the run ends with it, or None.

        Parameters
        ----------
        theta : parameters after the step, of shape (p,)
        record : of the step; its time and held-out value are filled in here
        failure : why the linear solver found no step, if it did not
        """
        value = None if self.held_out is None else self.held_out(theta)
        record = replace(record, held_out=value, seconds=perf_counter() - self.started)
        if self.best is not None and value is not None:
            self.best.update(theta, record.step, value, self.stop.tolerance)
        # Not strictly greater, so that a problem with zero loss is idle too.
        self.idle = self.idle + 1 if record.loss >= (1 - self.stop.tolerance) * record.before else 0
        self.theta = theta
        self.history.append(record)
        if self.callback is not None:
            self.callback(record)
        sentence = self._sentence(record)
        return f"{sentence} {failure}" if sentence and failure else sentence

    def _sentence(self, record: Record) -> str | None:
        if self.idle >= self.stop.patience:
            taken = any(past.length > 0 for past in self.history) or record.loss == 0.0
            return f"Converged after {record.step} steps." if taken else "No step lowered the loss."
        if self.best is not None and self.best.idle >= self.stop.held_out_patience:
            return f"The held-out residuals stopped falling at step {self.best.step}."
        if self.stop.seconds is not None and record.seconds >= self.stop.seconds:
            return f"Stopped after {record.seconds:.1f} seconds, {record.step} steps."
        if record.step >= self.stop.steps:
            return f"Stopped at the limit of {self.stop.steps} steps."
        return None

    def solution(self, status: str, method: str, interrupted: bool = False) -> Solution:
        """Return the parameters of the least held-out value, or without one the last, and the history."""
        theta = self.theta if self.best is None else self.best.theta
        return Solution(theta, status, tuple(self.history), interrupted, method)


@dataclass(frozen=True)
class Record:
    """One outer step.

    Parameters
    ----------
    step : its number, from 1
    before, loss : |r|^2 / 2 on the step's own sample of points, before and after the step
    damping : damping of the step, or zero for methods without
    gain_ratio : actual over predicted decrease of the loss, or zero for methods without a prediction
    length : multiple of the solved direction, zero if no trial decreased the loss; Adam's learning rate
    held_out : value of the held-out residuals after the step, if there are any
    iterations : of an iterative linear solver
    seconds : since the start of the run
    eikonal : root mean square of |grad f| - 1 near the surface after the step, where the fit measures it
    """

    step: int
    before: float
    loss: float
    damping: float
    gain_ratio: float
    length: float
    held_out: float | None = None
    iterations: int = 0
    seconds: float = 0.0
    eikonal: float | None = None


Callback = Callable[[Record], None]


@dataclass(frozen=True)
class Solution:
    """Parameters theta, of shape (p,), the history, and `status`, the reason for stopping as a sentence.

    `method` is the optimiser's description of itself at the end.
    """

    theta: Tensor
    status: str
    history: tuple[Record, ...]
    interrupted: bool = False
    method: str = ""

    def __repr__(self) -> str:
        return f"<Solution: {len(self.theta):,} parameters, {len(self.history):,} records; {self.status}>"
