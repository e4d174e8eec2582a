"""The Gauss-Newton loop: sample, linearise, search, repeat until a stop rule holds.

Each outer step k freezes a problem (its points may be fresh), hands J and r to the linear solver once, and asks the
search for a move. In function space the undamped step is the natural-gradient direction of the paper (its section on Gauss-Newton
in function space); damping and length only decide how far along it to go.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

from torch import Tensor

from gnrecon.linalg.cholesky import Cholesky
from gnrecon.linalg.system import LinearSolver
from gnrecon.optim.problem import Problem
from gnrecon.optim.search import Search
from gnrecon.optim.solution import Callback, Record, Solution


@dataclass(frozen=True)
class StopRule:
    """Stop after `steps`, or when `patience` steps in a row each lower their loss by less than `tolerance` of it."""

    steps: int = 50
    tolerance: float = 1e-3
    patience: int = 3


@dataclass(frozen=True)
class GaussNewton:
    """Gauss-Newton with a given search and linear solver."""

    search: Search
    solver: LinearSolver = field(default_factory=Cholesky)

    def run(
        self,
        problem_at: Callable[[int, Tensor], Problem],
        theta: Tensor,
        stop: StopRule,
        callback: Callback | None = None,
    ) -> Solution:
        """Minimise |r|^2 / 2 from theta, of shape (p,).

        An interrupt (Ctrl-C) ends the loop with the parameters of the last finished step.

        Parameters
        ----------
        problem_at : gives the frozen problem of a step from its number and the current parameters
        theta : starting parameters, of shape (p,)
        stop : when to stop
        callback : called with each step's record
        """
        history: list[Record] = []
        damping = self.search.initial_damping
        idle = 0
        try:
            for number in range(1, stop.steps + 1):
                problem = problem_at(number, theta)
                free = problem.free()
                system = self.solver.linearise(*problem.linearise(free), self.search.metric)
                if not math.isfinite(system.loss):
                    return Solution(theta, f"The loss was not finite at step {number}.", tuple(history))
                move = self.search.advance(problem, system, free, damping)
                theta, damping = problem.whole(move.free), move.next_damping
                record = Record(number, system.loss, move.loss, move.damping, move.gain_ratio, move.length)
                history.append(record)
                if callback is not None:
                    callback(record)
                # Not strictly greater, so that a problem without any loss left is idle too.
                idle = idle + 1 if record.loss >= (1 - stop.tolerance) * record.before else 0
                if idle >= stop.patience:
                    taken = any(past.length > 0 for past in history) or record.loss == 0.0
                    status = f"Converged after {number} steps." if taken else "No step lowered the loss."
                    return Solution(theta, status, tuple(history))
        except KeyboardInterrupt:
            return Solution(theta, f"Interrupted after {len(history)} steps.", tuple(history), interrupted=True)
        return Solution(theta, f"Stopped at the limit of {stop.steps} steps.", tuple(history))
