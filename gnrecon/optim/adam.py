"""Adam with cosine annealing, the first-order method that the paper compares with.

Each outer step freezes a problem, takes its gradient g = J^T r, and moves the parameters by the learning rate times
m / (sqrt(v) + 1e-8), m and v being running means of g and of its squares. The learning rate falls along half a cosine
from its first value at the first step to zero after the last of the limit's steps; in a run that time ends long before,
it hardly falls. Where only some parameters are free, the others' gradients count as zero in the running means, and they
stay where they are. Source: Kingma and Ba, Adam: a method for stochastic optimization (2015); Loshchilov and Hutter,
SGDR (2017), without restarts; the paper's appendix on hyperparameters.

A single step of Adam says little: many small ones, some of them uphill, make the progress, and the cosine plans all of
them. So neither idle steps nor held-out residuals end a run, only the limits of steps and time; of the held-out
residuals, the parameters of the least value are returned all the same.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.optim.lr_scheduler import CosineAnnealingLR

from gnrecon.optim.optimiser import Outcome, iterate
from gnrecon.optim.problem import Problem, ProblemAt, loss_and_gradient, loss_of, places_of
from gnrecon.optim.solution import Callback, Record, Solution
from gnrecon.optim.stop import HeldOut, StopRule, Watch


@dataclass(frozen=True)
class Adam:
    """Adam, one gradient an outer step."""

    learning_rate: float = 1e-3

    def run(
        self,
        problem_at: ProblemAt,
        theta: Tensor,
        stop: StopRule,
        callback: Callback | None = None,
        held_out: HeldOut | None = None,
    ) -> Solution:
        """Minimise |r|^2 / 2 from theta, of shape (p,); see `Optimiser`."""
        point = theta.clone()
        adam = torch.optim.Adam([point], lr=self.learning_rate)
        cosine = CosineAnnealingLR(adam, max(stop.steps, 1))

        def advance(number: int, problem: Problem) -> Outcome:
            free, places = problem.free(), places_of(problem)
            before, gradient = loss_and_gradient(problem, free)
            point.copy_(problem.whole(free))
            point.grad = torch.zeros_like(point).index_copy(0, places, gradient)
            rate = float(cosine.get_last_lr()[0])
            adam.step()
            cosine.step()
            moved = point[places]
            return Outcome(problem.whole(moved), Record(number, before, loss_of(problem, moved), 0.0, 0.0, rate))

        never = stop.steps + 1
        patient = replace(stop, patience=never, held_out_patience=never)
        return iterate(advance, problem_at, Watch(theta, patient, callback, held_out), self.describe)

    def describe(self) -> str:
        """Name the method and its learning rate."""
        return f"Adam, learning rate {self.learning_rate:g} with cosine annealing."
