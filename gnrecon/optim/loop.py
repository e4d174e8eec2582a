"""What all optimisers offer, and the loop that they share: freeze a problem, take a step, ask whether to stop.

They differ in how they take an outer step. Whatever they do, a loss that is not finite ends the run with the parameters
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
        held_out: HeldOut | None = None,
    ) -> Solution:
        """Minimise |r|^2 / 2 from theta, of shape (p,), which is left unchanged.

        Parameters
        ----------
        problem_at : gives the frozen problem of a step
        theta : starting parameters, of shape (p,)
        stop : when to stop
        callback : called with each step's record
        held_out : gives the loss of residuals that are kept from the fit, from all parameters; evaluated at the start
            and after each step, and the parameters of its least value are returned
        """
        ...

    def describe(self) -> str:
        """Return what this optimiser does, in sentences."""
        ...


@dataclass(frozen=True)
class Outcome:
    """What an outer step led to: all parameters, of shape (p,), its record, and why the solver failed, if it did."""

    theta: Tensor
    record: Record
    failure: str | None = None


Advance = Callable[[int, Problem], Outcome]
"""Takes the outer step of a number on its frozen problem."""


def iterate(advance: Advance, problem_at: ProblemAt, watch: Watch, describe: Callable[[], str]) -> Solution:
    """Take steps until a rule says stop."""
    status = f"Stopped at the limit of {watch.stop.steps} steps."
    try:
        watch.begin()
        for number in range(1, watch.stop.steps + 1):
            outcome = advance(number, problem_at(number, watch.theta))
            if not math.isfinite(outcome.record.before) or not math.isfinite(outcome.record.loss):
                return watch.solution(f"The loss was not finite at step {number}.", describe())
            ended = watch.note(outcome.theta, outcome.record, outcome.failure)
            if ended is not None:
                return watch.solution(ended, describe())
    except KeyboardInterrupt:
        return watch.solution(f"Interrupted after {len(watch.history)} steps.", describe(), interrupted=True)
    return watch.solution(status, describe())


HeldOut = Callable[[Tensor], float]
"""Gives the held-out residuals' loss from all parameters, of shape (p,)."""


# When a run ends, and with which sentence.
#
# After each outer step, in this order:
#
#     idle       `patience` steps in a row each lowered their loss by less than `tolerance` of it
#     held-out   residuals that the fit does not see have not fallen by `tolerance` of their least value for
#                `held_out_patience` steps: the fit has begun to follow noise
#     time       `seconds` have passed
#     limit      `steps` are done
#
# Held-out residuals also decide which parameters are returned, whatever ends the run: those of their least value, the
# start's included. Source: Prechelt, Early stopping - but when? (1998), whose criterion of successive failures this is,
# with a threshold.


@dataclass(frozen=True)
class StopRule:
    """When to stop.

    Parameters
    ----------
    steps : stop after so many
    tolerance : relative decrease of a loss below which a step is idle
    patience : idle steps in a row after which the run has converged
    seconds : time after which no further step begins, or None
    held_out_patience : steps in a row without a decrease of the held-out residuals after which the run ends
    """

    steps: int = 50
    tolerance: float = 1e-3
    patience: int = 3
    seconds: float | None = None
    held_out_patience: int = 5


@dataclass
class Best:
    """The parameters of the least held-out value so far.

    Parameters
    ----------
    theta, step, value : of the least value
    bar : value that the next ones are measured against, the last one that was a decrease by the tolerance
    idle : steps in a row since then
    """

    theta: Tensor
    step: int = 0
    value: float = math.inf
    bar: float = math.inf
    idle: int = 0

    def note(self, theta: Tensor, step: int, value: float, tolerance: float) -> None:
        """Take note of the value at a step; as long as none was a number, the newest parameters are the best."""
        if value < self.value or math.isinf(self.value):
            self.theta, self.step = theta, step
        if value < self.value:
            self.value = value
        falls = value < (1 - tolerance) * self.bar
        self.bar, self.idle = (value, 0) if falls else (self.bar, self.idle + 1)


@dataclass
class Watch:
    """A run as it goes on: its history, its parameters after the last finished step, and whether it is to end.

    Parameters
    ----------
    theta : starting parameters, of shape (p,)
    stop : the rules
    callback : called with each step's record
    held_out : gives the held-out residuals' loss
    """

    theta: Tensor
    stop: StopRule
    callback: Callback | None = None
    held_out: HeldOut | None = None
    history: list[Record] = field(default_factory=list, init=False)
    idle: int = field(default=0, init=False)
    best: Best | None = field(default=None, init=False)
    started: float = field(default_factory=perf_counter, init=False)

    def begin(self) -> None:
        """Take note of the held-out residuals at the start."""
        if self.held_out is not None:
            self.best = Best(self.theta)
            value = self.held_out(self.theta)
            self.best.note(self.theta, 0, value, self.stop.tolerance)

    def note(self, theta: Tensor, record: Record, failure: str | None = None) -> str | None:
        """Take note of a finished step; return why the run ends with it, or None.

        Parameters
        ----------
        theta : parameters after the step, of shape (p,)
        record : of the step; its time and held-out value are filled in here
        failure : why the linear solver found no step, if it did not
        """
        value = None if self.held_out is None else self.held_out(theta)
        record = replace(record, held_out=value, seconds=perf_counter() - self.started)
        if self.best is not None and value is not None:
            self.best.note(theta, record.step, value, self.stop.tolerance)
        # Not strictly greater, so that a problem without any loss left is idle too.
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


# What an optimiser returns: parameters, a sentence that says why it stopped, and its history.


@dataclass(frozen=True)
class Record:
    """One outer step.

    Parameters
    ----------
    step : its number, from 1
    before, loss : |r|^2 / 2 on the step's own sample of points, before and after the step
    damping : with which the step was solved, or zero for methods that do not damp
    gain_ratio : decrease of the loss over the predicted one, or zero for methods that predict none
    length : multiple of the solved direction that was taken, zero when no trial improved; Adam's learning rate
    held_out : value of the held-out residuals after the step, if there are any
    iterations : of an iterative linear solver
    seconds : since the start of the run
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


Callback = Callable[[Record], None]


@dataclass(frozen=True)
class Solution:
    """Parameters theta, of shape (p,), the history, and `status`, the reason for stopping as a sentence.

    `method` is what the optimiser said of itself at the end.
    """

    theta: Tensor
    status: str
    history: tuple[Record, ...]
    interrupted: bool = False
    method: str = ""
