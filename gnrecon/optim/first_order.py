"""The methods that the paper compares with: Adam with cosine annealing, and L-BFGS.

Adam: each outer step freezes a problem, computes its gradient g = J^T r, and moves the parameters by the learning rate
times m / (sqrt(v) + 1e-8), where m and v are running means of g and of its squares. The learning rate falls along half
a cosine from its initial value to zero after the maximum number of steps; if the time limit ends a run early, it hardly
falls. If only some parameters are free, the others keep their values, and their gradients count as zero in the means.
Sources: Kingma and Ba, Adam: a method for stochastic optimization (2015); Loshchilov and Hutter, SGDR (2017), without
restarts; the paper's appendix on hyperparameters.

Single steps of Adam may increase the loss, and the cosine schedule covers all steps. So only the limits of steps and
time end a run, not idle steps or held-out residuals. The parameters with the least held-out loss are still returned.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.optim.lr_scheduler import CosineAnnealingLR

from gnrecon.optim.loop import Callback, Outcome, Record, RunMonitor, Solution, StopRule, ValidationLoss, iterate
from gnrecon.optim.problem import Problem, ProblemAt, loss_and_gradient, loss_of, places_of


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
        held_out: ValidationLoss | None = None,
    ) -> Solution:
        """Minimise |r|^2 / 2 from theta, of shape (p,); see `Optimiser`."""
        point = theta.clone()
        adam = torch.optim.Adam([point], lr=self.learning_rate)
        cosine = CosineAnnealingLR(adam, max(stop.steps, 1))

        def take_step(number: int, problem: Problem) -> Outcome:
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
        return iterate(take_step, problem_at, RunMonitor(theta, patient, callback, held_out), self.describe)

    def describe(self) -> str:
        """Name the method and its learning rate."""
        return f"Adam, learning rate {self.learning_rate:g} with cosine annealing."


# L-BFGS. An outer step freezes a problem and takes `inner` iterations on it. Each is along the gradient J^T r times
# an inverse Hessian built from the last `memory` pairs (change of the parameters, change of the gradient), to a
# length that satisfies the strong Wolfe conditions. Source: Nocedal and Wright, Numerical Optimization (2006),
# algorithms 3.5 and 7.4, as implemented in torch.
#
# The pairs are kept from one outer step to the next while the same parameters are free, as in the paper's runs,
# although a pair across two samples of points mixes two losses. The paper's appendix gives this as the reason why
# L-BFGS fails on moving surfaces. The pairs are dropped after an outer step that did not decrease the loss.
#
# torch rejects pairs whose product is below 1e-10, which the small losses of a fit would reach long before their
# minimum. The loss is therefore divided by its value when the pairs start, and torch's absolute tolerances are off.


@dataclass(frozen=True)
class Pairs:
    """torch's optimiser with its pairs, the tensor of shape (k,) that it moves, its places in theta, and the scale."""

    optimiser: torch.optim.LBFGS
    point: Tensor
    places: Tensor
    scale: float

    def minimise(self, problem: Problem, free: Tensor, *, non_finite_loss: float = 1e30) -> Tensor:
        """Return the free parameters, of shape (k,), after the inner iterations.

        `non_finite_loss` replaces a scaled loss that is not finite: the line search interpolates, and turns back there.
        """

        def closure() -> float:
            loss, gradient = loss_and_gradient(problem, self.point.clone())
            finite = math.isfinite(loss) and bool(gradient.isfinite().all())
            self.point.grad = self.scale * gradient if finite else torch.zeros_like(gradient)
            return self.scale * loss if finite else non_finite_loss

        self.point.copy_(free)
        self.optimiser.step(closure)  # type: ignore[no-untyped-call]
        return self.point.clone()


@dataclass(frozen=True)
class LBFGS:
    """L-BFGS.

    Parameters
    ----------
    learning_rate : initial length of the line searches
    memory : number of pairs
    inner : most iterations of an outer step, and 4/5 of its most evaluations
    """

    learning_rate: float = 1.0
    memory: int = 100
    inner: int = 20

    def run(
        self,
        problem_at: ProblemAt,
        theta: Tensor,
        stop: StopRule,
        callback: Callback | None = None,
        held_out: ValidationLoss | None = None,
    ) -> Solution:
        """Minimise |r|^2 / 2 from theta, of shape (p,); see `Optimiser`."""
        pairs: Pairs | None = None

        def take_step(number: int, problem: Problem) -> Outcome:
            nonlocal pairs
            free, places = problem.free(), places_of(problem)
            before = loss_of(problem, free)
            stays = Outcome(problem.whole(free), Record(number, before, before, 0.0, 0.0, 0.0))
            if not len(free):
                return stays
            if pairs is None or not torch.equal(pairs.places, places):
                pairs = self._begin(free, places, before)
            moved = pairs.minimise(problem, free)
            loss = loss_of(problem, moved)
            if loss >= before:
                pairs = None
                return stays
            return Outcome(problem.whole(moved), Record(number, before, loss, 0.0, 0.0, 1.0))

        return iterate(take_step, problem_at, RunMonitor(theta, stop, callback, held_out), self.describe)

    def _begin(self, free: Tensor, places: Tensor, loss: float) -> Pairs:
        point = free.clone()
        optimiser = torch.optim.LBFGS(
            [point],
            lr=self.learning_rate,
            max_iter=self.inner,
            tolerance_grad=0.0,
            tolerance_change=0.0,
            history_size=self.memory,
            line_search_fn="strong_wolfe",
        )
        return Pairs(optimiser, point, places, 1.0 / loss if loss > 0.0 else 1.0)

    def describe(self) -> str:
        """Name the method and its numbers."""
        return f"L-BFGS, strong Wolfe lines, {self.memory} pairs, {self.inner} iterations a step."
