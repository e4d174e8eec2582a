"""Learns a shape: fits the network to a start, and then to the constraints of a problem.

Each step draws new points, as in the paper, and takes a step of the optimiser on them. Gauss-Newton is damped by the
gain ratio in the identity metric (`optim.step_control`), from a damping of one, so that the first steps do not tear the
surface. The damping falls with the loss, and the last steps are nearly undamped. In the paper all steps are a tenth of
the undamped direction.

The surface is measured at increasing intervals, at new points, and the parameters with the least measured loss are
returned. For Gauss-Newton these are nearly always the last ones; for runs of L-BFGS that lose their surface, the best
before that. Each step overfits its own points, so an exponential mean of the last steps' parameters is measured too.
Source: Polyak and Juditsky, Acceleration of stochastic approximation by averaging (1992), here with decreasing weights.

Gauss-Newton may start with a wider network (`wider`) and remove the additional units one by one, with some steps after
each (`pruning`). On the rocker arm the final loss is a seventh lower than that of a network that was never wider
(docs/research/2026-11-25-vertex-normals-and-width.md).
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
from gnrecon.shape_learning.learning_parameters import RunParameters, ShapeLearningParameters
from gnrecon.shape_learning.pruning import narrower, widened
from gnrecon.shape_learning.result import LearnedField, Measurement, measure
from gnrecon.shape_learning.shape_problem import Pretraining, SampledPoints, ShapeProblem, StepState, Term

OPTIMISERS: dict[str, Callable[[ShapeProblem, float], Optimiser]] = {
    "gn": lambda problem, rate: GaussNewton(problem.search, problem.solver()),  # noqa: ARG005 (one signature for all)
    "lbfgs": lambda problem, rate: LBFGS(),  # noqa: ARG005
    "adam": lambda problem, rate: Adam(rate),  # noqa: ARG005
}
"""Creates each optimiser by its name, for a problem and with a learning rate for Adam."""

MeasurementCallback = Callable[[Measurement], None]


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
class _LearningRun:
    """The state of a run: when the next measurement is due, and the best parameters so far."""

    problem: ShapeProblem
    rng: np.random.Generator
    seed: int
    steps: int
    budget: float | None
    callback: MeasurementCallback | None
    parameters: RunParameters
    started: float = field(default_factory=perf_counter)
    history: list[Measurement] = field(default_factory=list)
    best: tuple[Measurement, Tensor] | None = None
    mean: Tensor | None = None
    records: list[Record] = field(default_factory=list)
    interrupted: Solution | None = None
    due: float = field(init=False)

    def __post_init__(self) -> None:
        self.due = self.parameters.first_measurement

    @property
    def steps_left(self) -> int:
        """Steps that may still be taken."""
        return max(self.steps - len(self.records), 0)

    @property
    def seconds_left(self) -> float | None:
        """The remaining seconds of the budget, if there is one."""
        return None if self.budget is None else self.budget - (perf_counter() - self.started)

    def problem_at(self, number: int, theta: Tensor) -> Problem:
        """Measure the last step's result if a measurement is due, and freeze the next problem."""
        self.average(theta)
        passed = number - 1 if self.budget is None else perf_counter() - self.started
        if passed >= self.due and number > 1:
            self.due = max(self.due * self.parameters.measurement_growth, passed + (1 if self.budget is None else 0.0))
            self.record(number - 1, theta)
        return self.problem.freeze(number, theta, self.rng)

    def run_optimiser(self, method: Optimiser, theta: Tensor, steps: int, seconds: float | None) -> Solution:
        """Run an optimiser, and continue the numbers of the steps, unless the run has been interrupted."""
        if self.interrupted is not None:
            return replace(self.interrupted, theta=theta)
        done = len(self.records)
        # Losses of different samples cannot be compared, so only steps, time or the user end the run.
        stop = StopRule(steps, tolerance=0.0, patience=steps + 1, seconds=seconds)
        solution = method.run(lambda number, theta: self.problem_at(done + number, theta), theta, stop)
        self.records += [replace(record, step=done + record.step) for record in solution.history]
        earlier = f" Before these, {done} steps had more units." if done else ""
        solution = replace(solution, history=tuple(self.records), status=solution.status + earlier)
        self.interrupted = solution if solution.interrupted else None
        return solution

    def narrow(self, network: Network) -> None:
        """Replace the network by a narrower one, and discard the best parameters of the wider one."""
        self.problem, self.best, self.mean = replace(self.problem, network=network), None, None

    def average(self, theta: Tensor) -> None:
        """Update the mean of the parameters."""
        self.mean = theta if self.mean is None else theta.lerp(self.mean, self.parameters.mean_memory)

    def record(self, step: int, theta: Tensor) -> None:
        """Measure the parameters and their mean, and keep the better ones if their loss is the least so far."""
        found = self.measured(step, theta)
        if self.mean is not None:  # there is none at the start
            of_mean = self.measured(step, self.mean)
            if of_mean.loss < found.loss:
                found, theta = of_mean, self.mean
        self.history.append(found)
        if self.best is None or found.loss < self.best[0].loss:
            self.best = (found, theta.clone())
        if self.callback is not None:
            self.callback(found)

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
    callback: MeasurementCallback | None = None,
    wider: int = 0,
    parameters: RunParameters = ShapeLearningParameters.run,
) -> Learned:
    """Learn a shape.

    An interrupt (Ctrl-C) ends the run with the best parameters so far and sets `Learned.solution.interrupted`.

    Parameters
    ----------
    problem : ShapeProblem
    optimiser : gn, lbfgs or adam
    budget : seconds after which no further step begins, pretraining and measurements included; None for no limit
    steps : most steps; without a budget, the same problem, steps and seed give the same parameters on one machine
    seed : of the network's initial parameters and of all points
    learning_rate : of Adam
    callback : called with each measurement
    wider : additional hidden units per layer at the start, which are removed before the end. Gauss-Newton only
    parameters : of the run

    Raises
    ------
    UsageError
        When the optimiser is unknown, there is neither a budget nor a number of steps, or `wider` is negative or used
        with another optimiser than Gauss-Newton.
    FitError
        When the start cannot be fitted, or the surface vanishes before the first measurement or during pruning.
    """
    if optimiser not in OPTIMISERS:
        raise UsageError(f"The optimiser is {optimiser!r}, but must be one of {', '.join(OPTIMISERS)}.")
    if (
        (budget is None and steps is None)
        or (budget is not None and not budget > 0)
        or (steps is not None and steps < 1)
    ):
        raise UsageError("Give a positive budget in seconds or a positive number of steps.")
    if wider < 0 or (wider and optimiser != "gn"):
        raise UsageError("The number of additional units must be 0 or more, and only Gauss-Newton can start wider.")
    rng = np.random.default_rng(seed)
    wide = replace(problem, network=widened(problem.network, wider))
    run = _LearningRun(wide, rng, seed, parameters.most_steps if steps is None else steps, budget, callback, parameters)
    seconds = None if budget is None else parameters.pretraining_budget_share * budget
    theta = pretrained(wide, seed, rng, seconds, parameters)
    run.record(0, theta)
    method = OPTIMISERS[optimiser](problem, learning_rate)
    if wider:
        assert isinstance(method, GaussNewton), "the others have been refused"
        method, theta = _pruned(run, theta, method, problem)
    return _finished(run, theta, _solved(run, theta, method))


def _pruned(run: _LearningRun, theta: Tensor, method: GaussNewton, problem: ShapeProblem) -> tuple[GaussNewton, Tensor]:
    """Take steps with the wider network and remove units until it is the problem's own; return how to continue."""
    parameters = run.parameters
    goal = problem.network.widths
    steps, seconds = run.steps_left, run.seconds_left
    if run.budget is None or seconds is None:
        steps = round(parameters.wide_budget_share * run.steps)
    else:
        seconds = min(seconds, parameters.wide_budget_share * run.budget)
    while run.problem.network.widths != goal:
        if steps and (seconds is None or seconds > 0):
            theta = run.run_optimiser(method, theta, steps, seconds).theta
        if run.records:
            damping = parameters.removal_damping_factor * run.records[-1].damping
            method = replace(method, damping=min(damping, parameters.most_removal_damping))
        network, theta = narrower(run.problem.freeze(len(run.records) + 1, theta, run.rng), goal)
        run.narrow(network)
        method = replace(method, solver=problem.solver())  # the old one may keep matrices of the wider network
        steps, seconds = min(parameters.steps_per_removal, run.steps_left), run.seconds_left
    run.record(len(run.records), theta)
    return method, theta


def _solved(run: _LearningRun, theta: Tensor, method: Optimiser) -> Solution:
    """Run the optimiser; the run also ends when the surface vanishes."""
    try:
        return run.run_optimiser(method, theta, run.steps_left, run.seconds_left)
    except FitError as error:
        if run.best is None:
            raise
        return Solution(run.best[1], str(error), tuple(run.records))


def _finished(run: _LearningRun, start: Tensor, solution: Solution) -> Learned:
    last = solution.theta
    if solution.history and last is not start and bool(last.isfinite().all()):
        run.average(last)
        run.record(len(solution.history), last)
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


# Pretraining by Gauss-Newton: on the start's values at new uniform points, or on the terms of a problem's pretraining.
#
# The paper pretrains on a shape of the wanted topology for thousands of steps; here a few dozen are enough. The damping
# is the same for all parameters: in units of J^T J's diagonal, saturated units could move any distance at no cost.


def pretrained(
    problem: ShapeProblem,
    seed: int,
    rng: np.random.Generator,
    seconds: float | None = None,
    parameters: RunParameters = ShapeLearningParameters.run,
) -> Tensor:
    """Return parameters, of shape (p,), with which the network is the problem's start; within `seconds`, if given."""
    fit = problem.pretraining or _pretraining_on_values(problem, parameters)

    def freeze(number: int, theta: Tensor) -> FrozenProblem:
        return problem.freeze(number, theta, rng, fit.terms)

    theta = problem.network.initial(torch.Generator().manual_seed(seed))
    method = GaussNewton(GainRatioDamping(initial_damping=1e-2, metric=identity))
    solution = method.run(freeze, theta, StopRule(fit.steps, fit.tolerance, fit.patience, seconds))
    if solution.interrupted:  # there is no surface of the problem yet
        raise KeyboardInterrupt
    return solution.theta


def _pretraining_on_values(problem: ShapeProblem, parameters: RunParameters) -> Pretraining:
    """Return the fit of the start's values in the problem's box."""

    def draw(state: StepState) -> SampledPoints:
        points = torch.as_tensor(problem.box.sample(parameters.pretraining_points, state.rng))
        return SampledPoints(points, problem.start(points))

    return Pretraining((Term("start", signed_distance, draw),), parameters.pretraining_steps)
