"""Learning a shape: the network becomes the start, and then whatever its problem's constraints ask of it.

Each step draws its points afresh, as the paper does, and takes a step of the optimiser on them. Gauss-Newton is damped
by the gain ratio in the identity metric (`optim.damping`), from a damping of one, so that the first steps do not tear
the surface; the damping then falls with the loss, and the steps end as undamped ones. The paper's steps are a tenth of
the undamped direction throughout.

The surface is measured now and then, at fresh points, and the parameters of the least loss measured are returned. Of
Gauss-Newton these are nearly always the last ones; runs of L-BFGS that lose their surface keep the best that they had.
Each step fits its own points somewhat better than all, in another way each time, so that a mean over the last few
steps' parameters is measured as well. Source: Polyak and Juditsky, Acceleration of stochastic approximation by
averaging (1992), with weights that fall off, as there is no end at which to begin.

Gauss-Newton may begin with a wider network (`wider`), and take the units that are too many away again, one by one,
with some steps after each (`shapes.prune`). On the rocker arm that ends a seventh lower than the same network does
that was never wider (docs/research/2026-11-25-vertex-normals-and-width.md).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from time import perf_counter

import numpy as np
import torch
from torch import Tensor

from gnrecon.field import Network
from gnrecon.least_squares import identity
from gnrecon.optim import LBFGS, Adam, GainRatioDamping, GaussNewton, Optimiser, Problem, Record, Solution, StopRule
from gnrecon.residuals import signed_distance
from gnrecon.runtime.errors import FitError, UsageError
from gnrecon.shape_learning.frozen_points import FrozenProblem
from gnrecon.shape_learning.pruning import narrower, widened
from gnrecon.shape_learning.result import LearnedField, Measurement, measure
from gnrecon.shape_learning.shape_problem import Drawn, Moment, Pretraining, ShapeProblem, Term

OPTIMISERS: dict[str, Callable[[ShapeProblem, float], Optimiser]] = {
    "gn": lambda problem, rate: GaussNewton(problem.search, problem.solver()),  # noqa: ARG005 (one signature for all)
    "lbfgs": lambda problem, rate: LBFGS(),  # noqa: ARG005
    "adam": lambda problem, rate: Adam(rate),  # noqa: ARG005
}
"""Makes each optimiser by its name, for a problem and with a learning rate for Adam."""

MOST_STEPS = 10**6

FIRST, GROWTH = 5.0, 1.5
"""Seconds or steps to the first measurement, and the factor from one to the next."""

PRETRAINING = 0.25
"""Share of the budget within which the network must have become the start."""

WIDE, BETWEEN = 0.14, 4
"""Share of the budget for which a wider network is kept, and steps after each unit that is taken away."""

EASED, MOST_DAMPED = 3.0, 1e-3
"""Factor on the damping of the last step once a unit is gone, and the most that it then is."""

KEEP = 0.6
"""Share of the former mean of the parameters in the next one."""

Heard = Callable[[Measurement], None]


@dataclass(frozen=True)
class Learned:
    """A learned shape.

    Parameters
    ----------
    field : the field, whose zero level is the surface
    best : its measurement
    history : all measurements, in order
    solution : what the optimiser returned
    seconds : of the whole run
    """

    field: LearnedField
    best: Measurement
    history: tuple[Measurement, ...]
    solution: Solution
    seconds: float


@dataclass
class _Run:
    """A run as it goes on: when the next measurement is due, and the best parameters so far."""

    problem: ShapeProblem
    rng: np.random.Generator
    seed: int
    steps: int
    budget: float | None
    heard: Heard | None
    started: float = field(default_factory=perf_counter)
    due: float = FIRST
    history: list[Measurement] = field(default_factory=list)
    best: tuple[Measurement, Tensor] | None = None
    mean: Tensor | None = None
    records: list[Record] = field(default_factory=list)
    interrupted: Solution | None = None

    @property
    def steps_left(self) -> int:
        """Steps that may still be taken."""
        return max(self.steps - len(self.records), 0)

    @property
    def seconds_left(self) -> float | None:
        """Seconds that are left, if they are limited."""
        return None if self.budget is None else self.budget - (perf_counter() - self.started)

    def problem_at(self, number: int, theta: Tensor) -> Problem:
        """Measure what the last step led to, if that is due, and freeze the next problem."""
        self.average(theta)
        passed = number - 1 if self.budget is None else perf_counter() - self.started
        if passed >= self.due and number > 1:
            self.due = max(self.due * GROWTH, passed + (1 if self.budget is None else 0.0))
            self.note(number - 1, theta)
        return self.problem.freeze(number, theta, self.rng)

    def go_on(self, method: Optimiser, theta: Tensor, steps: int, seconds: float | None) -> Solution:
        """Run an optimiser, whose steps count from the last one taken, unless the run has been interrupted."""
        if self.interrupted is not None:
            return replace(self.interrupted, theta=theta)
        done = len(self.records)
        # The losses of different samples do not compare, so that only steps, time or the user end the run.
        stop = StopRule(steps, tolerance=0.0, patience=steps + 1, seconds=seconds)
        solution = method.run(lambda number, theta: self.problem_at(done + number, theta), theta, stop)
        self.records += [replace(record, step=done + record.step) for record in solution.history]
        earlier = f" Before these, {done} steps had more units." if done else ""
        solution = replace(solution, history=tuple(self.records), status=solution.status + earlier)
        self.interrupted = solution if solution.interrupted else None
        return solution

    def narrow(self, network: Network) -> None:
        """Go on with a narrower network; what was best of the wider one is no answer any more."""
        self.problem, self.best, self.mean = replace(self.problem, network=network), None, None

    def average(self, theta: Tensor) -> None:
        """Take parameters into their mean."""
        self.mean = theta if self.mean is None else theta.lerp(self.mean, KEEP)

    def note(self, step: int, theta: Tensor) -> None:
        """Measure, also the mean, and keep the parameters where their loss is the least so far."""
        found = self.measured(step, theta)
        if self.mean is not None:  # there is none at the start
            of_mean = self.measured(step, self.mean)
            if of_mean.loss < found.loss:
                found, theta = of_mean, self.mean
        self.history.append(found)
        if self.best is None or found.loss < self.best[0].loss:
            self.best = (found, theta.clone())
        if self.heard is not None:
            self.heard(found)

    def measured(self, step: int, theta: Tensor) -> Measurement:
        """Measure parameters."""
        return measure(self.problem, theta, step, perf_counter() - self.started, self.seed)


def learn(
    problem: ShapeProblem,
    optimiser: str = "gn",
    *,
    budget: float | None = 600.0,
    steps: int | None = None,
    seed: int = 0,
    learning_rate: float = 1e-3,
    heard: Heard | None = None,
    wider: int = 0,
) -> Learned:
    """Learn a shape.

    An interrupt (Ctrl-C) keeps the best until then; `Learned.solution.interrupted` then says so.

    Parameters
    ----------
    problem : ShapeProblem
    optimiser : gn, lbfgs or adam
    budget : seconds after which no further step begins, the start and all measuring included; None for no limit
    steps : most steps; the same problem, steps and seed give the same parameters on a machine, which a budget cannot
    seed : of the network's start and of all points
    learning_rate : of Adam
    heard : told of each measurement
    wider : hidden units more that each layer begins with; they are gone in the end. Gauss-Newton only

    Raises
    ------
    UsageError
        When the optimiser is unknown, neither a budget nor steps end the run, or `wider` is negative or for another
        optimiser than Gauss-Newton.
    FitError
        When the start cannot be fitted, or the surface has vanished before it was ever measured, or while units go.
    """
    if optimiser not in OPTIMISERS:
        raise UsageError(f"The optimiser is {optimiser!r}, but must be one of {', '.join(OPTIMISERS)}.")
    if (
        (budget is None and steps is None)
        or (budget is not None and not budget > 0)
        or (steps is not None and steps < 1)
    ):
        raise UsageError("A positive budget of seconds or number of steps must say when the run ends.")
    if wider < 0 or (wider and optimiser != "gn"):
        raise UsageError("A network can begin wider by a number of units from 0 on, and by Gauss-Newton alone.")
    rng = np.random.default_rng(seed)
    wide = replace(problem, network=widened(problem.network, wider))
    run = _Run(wide, rng, seed, MOST_STEPS if steps is None else steps, budget, heard)
    theta = pretrained(wide, seed, rng, None if budget is None else PRETRAINING * budget)
    run.note(0, theta)
    method = OPTIMISERS[optimiser](problem, learning_rate)
    if wider:
        assert isinstance(method, GaussNewton), "the others have been refused"
        method, theta = _narrowed(run, theta, method, problem)
    return _finished(run, theta, _solved(run, theta, method))


def _narrowed(run: _Run, theta: Tensor, method: GaussNewton, problem: ShapeProblem) -> tuple[GaussNewton, Tensor]:
    """Take steps with the wider network, and units away until it is the problem's own; return how to go on."""
    goal = problem.network.widths
    steps, seconds = run.steps_left, run.seconds_left
    if run.budget is None or seconds is None:
        steps = round(WIDE * run.steps)
    else:
        seconds = min(seconds, WIDE * run.budget)
    while run.problem.network.widths != goal:
        if steps and (seconds is None or seconds > 0):
            theta = run.go_on(method, theta, steps, seconds).theta
        if run.records:
            method = replace(method, damping=min(EASED * run.records[-1].damping, MOST_DAMPED))
        network, theta = narrower(run.problem.freeze(len(run.records) + 1, theta, run.rng), goal)
        run.narrow(network)
        method = replace(method, solver=problem.solver())  # a new one, as it may keep matrices of the wider network
        steps, seconds = min(BETWEEN, run.steps_left), run.seconds_left
    run.note(len(run.records), theta)
    return method, theta


def _solved(run: _Run, theta: Tensor, method: Optimiser) -> Solution:
    """Run the optimiser, and take the loss of the surface for the end of the run."""
    try:
        return run.go_on(method, theta, run.steps_left, run.seconds_left)
    except FitError as error:
        if run.best is None:
            raise
        return Solution(run.best[1], str(error), tuple(run.records))


def _finished(run: _Run, start: Tensor, solution: Solution) -> Learned:
    last = solution.theta
    if solution.history and last is not start and bool(last.isfinite().all()):
        run.average(last)
        run.note(len(solution.history), last)
    assert run.best is not None, "the start has been measured"
    best, theta = run.best
    problem = run.problem
    return Learned(
        LearnedField(problem.network, theta, problem.box),
        best,
        tuple(run.history),
        solution,
        perf_counter() - run.started,
    )


POINTS, STEPS = 1500, 15


# What the network begins as, by Gauss-Newton: the start's values at fresh uniform points, or what a problem says.
#
# The paper pretrains on a shape of the wanted topology for thousands of steps; here a few dozen do. Their damping is
# the same for all parameters: in units of J^T J's diagonal, saturated units could be moved any distance at no cost.


def pretrained(problem: ShapeProblem, seed: int, rng: np.random.Generator, seconds: float | None = None) -> Tensor:
    """Return parameters, of shape (p,), with which the network is the problem's start; within `seconds`, if given."""
    what = problem.pretraining or _on_values(problem)

    def freeze(number: int, theta: Tensor) -> FrozenProblem:
        return problem.freeze(number, theta, rng, what.terms)

    theta = problem.network.initial(torch.Generator().manual_seed(seed))
    method = GaussNewton(GainRatioDamping(initial_damping=1e-2, metric=identity))
    return method.run(freeze, theta, StopRule(what.steps, what.tolerance, what.patience, seconds)).theta


def _on_values(problem: ShapeProblem) -> Pretraining:
    """Return the fit of the start's values in the problem's box."""

    def draw(moment: Moment) -> Drawn:
        points = torch.as_tensor(problem.box.sample(POINTS, moment.rng))
        return Drawn(points, problem.start(points))

    return Pretraining((Term("start", signed_distance, draw),), STEPS)
