"""Gauss-Newton: linearise the residuals and solve the linear least-squares problem for a step.

Each outer step k freezes a problem (its points may be fresh), hands J and r to the linear solver once, and asks the
search for a move. In function space the undamped step is the natural-gradient direction of the paper (its section on
Gauss-Newton in function space); damping and length only decide how far along it to go.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from torch import Tensor

from gnrecon.least_squares.direct import Cholesky
from gnrecon.least_squares.system import LinearSolver
from gnrecon.optim.loop import Callback, HeldOut, Outcome, Record, Solution, StopRule, Watch, iterate
from gnrecon.optim.problem import Problem, ProblemAt
from gnrecon.optim.step_control import Search


@dataclass(frozen=True)
class GaussNewton:
    """Gauss-Newton with a given search and linear solver.

    Parameters
    ----------
    search : step control
    solver : of the linear systems
    damping : of the first step, by default the search's own; for a run that goes on where another one ended
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
        held_out: HeldOut | None = None,
    ) -> Solution:
        """Minimise |r|^2 / 2 from theta, of shape (p,); see `Optimiser`."""
        damping = self.search.initial_damping if self.damping is None else self.damping

        def advance(number: int, problem: Problem) -> Outcome:
            nonlocal damping
            free = problem.free()
            system = self.solver.linearise(*problem.linearise(free), self.search.metric)
            move = self.search.advance(problem, system, free, damping)
            damping = move.next_damping
            record = Record(
                number, system.loss, move.loss, move.damping, move.gain_ratio, move.length, iterations=move.iterations
            )
            return Outcome(problem.whole(move.free), record, move.failure)

        return iterate(advance, problem_at, Watch(theta, stop, callback, held_out), self.describe)

    def describe(self) -> str:
        """Name the search and the solver."""
        return f"{self.search.describe()} {self.solver.describe()}"
