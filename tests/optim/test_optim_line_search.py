"""Searches along one direction try what they say, from one start, and a trial that lost leaves no trace."""

from __future__ import annotations

import math

import pytest
import torch
from least_squares_problems import CASES
from scripted import posed

from gnrecon.optim import FixedStep, GaussNewton, LogLineSearch, StopRule
from gnrecon.optim.problem import loss_of


def test_line_search_tries_log_spaced_lengths_from_one_start() -> None:
    search = LogLineSearch(trials=15)
    problem, system, theta = posed(search)
    move = search.advance(problem, system, theta, search.initial_damping)
    step = system.solve(search.initial_damping)
    lengths = [float((trial - theta) @ step.direction / step.direction.square().sum()) for trial in problem.asked]
    assert lengths == pytest.approx([2.0**-k for k in range(15)])
    for trial, length in zip(problem.asked, lengths, strict=True):
        torch.testing.assert_close(trial, theta + length * step.direction)
    losses = [loss_of(problem.inner, trial) for trial in problem.asked]
    best = min(range(15), key=losses.__getitem__)
    assert move.loss == losses[best]
    assert move.length == pytest.approx(lengths[best])
    assert torch.equal(move.free, problem.asked[best])
    assert move.gain_ratio == pytest.approx((system.loss - move.loss) / step.predicted)


def test_line_search_keeps_the_best_of_several_improvements() -> None:
    search = LogLineSearch(trials=5)
    problem, system, theta = posed(search, [90.0, 8.0, 3.0, math.nan, 5.0])
    move = search.advance(problem, system, theta, search.initial_damping)
    assert torch.equal(move.free, problem.asked[2])
    assert move.loss == pytest.approx(3.0)


def test_line_search_without_an_improvement_stays() -> None:
    search = LogLineSearch(trials=4)
    problem, system, theta = posed(search, [90.0, math.inf, math.nan, 1e6])
    move = search.advance(problem, system, theta, search.initial_damping)
    assert torch.equal(move.free, theta)
    assert (move.loss, move.length) == (system.loss, 0.0)


def test_a_line_search_of_one_trial_takes_the_whole_step() -> None:
    search = LogLineSearch(trials=1)
    problem, system, theta = posed(search, [1.0])
    move = search.advance(problem, system, theta, search.initial_damping)
    assert torch.equal(move.free, theta + system.solve(search.initial_damping).direction)
    assert move.length == 1.0


@pytest.mark.parametrize("loss", [0.5, 1e6])
def test_a_fixed_step_is_taken_whatever_it_does_to_the_loss(loss: float) -> None:
    search = FixedStep(length=0.3)
    problem, system, theta = posed(search, [loss])
    move = search.advance(problem, system, theta, search.initial_damping)
    step = system.solve(search.initial_damping)
    torch.testing.assert_close(move.free, theta + 0.3 * step.direction)
    assert move.loss == pytest.approx(loss)
    assert move.length == 0.3
    assert move.gain_ratio == pytest.approx((system.loss - loss) / step.predicted)
    assert move.next_damping == search.initial_damping


@pytest.mark.parametrize("loss", [math.inf, math.nan])
def test_a_fixed_step_is_not_taken_to_where_the_loss_is_not_finite(loss: float) -> None:
    search = FixedStep()
    problem, system, theta = posed(search, [loss])
    move = search.advance(problem, system, theta, search.initial_damping)
    assert torch.equal(move.free, theta)
    assert (move.loss, move.length) == (system.loss, 0.0)
    assert move.next_damping > search.initial_damping


def test_fixed_steps_approach_the_minimum_geometrically() -> None:
    """On a linear problem a step of length t leaves (1 - t)^2 of the loss."""
    case = CASES["circle, residual left"]

    def linear(theta: torch.Tensor) -> torch.Tensor:
        return torch.stack([3.0 * theta[0] + theta[1], theta[1] - 2.0 * theta[0]])

    problem, _, _ = posed(FixedStep(), formula=linear)
    run = GaussNewton(FixedStep(length=0.25)).run(lambda _, t: type(problem.inner)(linear, t), case.theta, StopRule(6))
    assert len(run.history) == 6
    for record in run.history:
        assert record.loss == pytest.approx(0.75**2 * record.before, rel=1e-5)
