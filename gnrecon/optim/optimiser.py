"""What all optimisers offer, and the loop that they share: freeze a problem, take a step, ask whether to stop.

They differ in how they take an outer step. Whatever they do, a loss that is not finite ends the run with the parameters
before it, and an interrupt (Ctrl-C) with those of the last finished step.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from gnrecon.optim.problem import Problem, ProblemAt
from gnrecon.optim.solution import Callback, Record, Solution
from gnrecon.optim.stop import HeldOut, StopRule, Watch


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
