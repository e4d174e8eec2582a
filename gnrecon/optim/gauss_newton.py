"""Gauss-Newton: linearise the residuals and solve the linear least-squares problem for a step.

Each outer step k freezes a problem (its points may be new), passes J and r to the linear solver once, and lets the
step control choose the step. In function space the undamped step is the natural-gradient direction of the paper (its
section on Gauss-Newton in function space); damping and length decide how far to go along it.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from torch import Tensor

from gnrecon.least_squares.direct import Cholesky
from gnrecon.least_squares.system import LinearSolver
from gnrecon.optim.loop import Callback, Outcome, Record, RunMonitor, Solution, StopRule, ValidationLoss, iterate
from gnrecon.optim.problem import Problem, ProblemAt
from gnrecon.optim.step_control import Search


@dataclass(frozen=True)
class GaussNewton:
    """Gauss-Newton with a step control and a linear solver.

    Parameters
    ----------
    search : step control
    solver : of the linear systems
    damping : of the first step, by default that of the search; for a run that continues another one
    """

    search: Search
    solver: LinearSolver = field(default_factory=Cholesky)
    damping: float | None = None

    def run(
        self,
        problem_at: ProblemAt,
        theta: Tensor,
        stop: StopRule,
        callback: Callback | None = None,
        held_out: ValidationLoss | None = None,
    ) -> Solution:
        """Minimise |r|^2 / 2 from theta, of shape (p,); see `Optimiser`."""
        damping = self.search.initial_damping if self.damping is None else self.damping

        def take_step(number: int, problem: Problem) -> Outcome:
            nonlocal damping
            free = problem.free()
            system = self.solver.linearise(*problem.linearise(free), self.search.metric)
            move = self.search.advance(problem, system, free, damping)
            damping = move.next_damping
            record = Record(
                number, system.loss, move.loss, move.damping, move.gain_ratio, move.length, iterations=move.iterations
            )
            return Outcome(problem.whole(move.free), record, move.failure)

        return iterate(take_step, problem_at, RunMonitor(theta, stop, callback, held_out), self.describe)

    def describe(self) -> str:
        """Name the search and the solver."""
        return f"{self.search.describe()} {self.solver.describe()}"
