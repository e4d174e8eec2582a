"""Adam and L-BFGS do what torch's own do when these are given the loss and its gradient by autograd."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from least_squares_problems import CASES, Case, Formula, Plain
from torch import Tensor

from gnrecon.optim import LBFGS, Adam, StopRule
from gnrecon.optim.problem import loss_and_gradient, loss_of, places_of

F64 = torch.float64
each_case = pytest.mark.parametrize("case", CASES.values(), ids=CASES.keys())


def half_square(formula: Formula, theta: Tensor) -> Tensor:
    return 0.5 * formula(theta).square().sum()


def random_problem(seed: int, scale: float = 1.0) -> tuple[Plain, Tensor]:
    """A linear problem, and its least squares."""
    generator = torch.Generator().manual_seed(seed)
    J, r = torch.randn(9, 4, generator=generator, dtype=F64), torch.randn(9, generator=generator, dtype=F64)
    best = torch.linalg.lstsq(J, -r).solution
    return Plain(lambda x: scale * (J @ x + r), torch.zeros(4, dtype=F64)), best


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**31), st.permutations(range(4)), st.integers(0, 4))
def test_places_and_gradient_of_the_free_parameters(seed: int, order: list[int], count: int) -> None:
    theta = torch.randn(4, generator=torch.Generator().manual_seed(seed), dtype=F64)
    chosen = torch.tensor(order[:count], dtype=torch.long)
    problem = Plain(random_problem(seed)[0].formula, theta, chosen)
    assert torch.equal(places_of(problem), chosen)
    loss, gradient = loss_and_gradient(problem, problem.free())
    at = theta.clone().requires_grad_()
    expected = half_square(problem.formula, at)
    expected.backward()
    assert at.grad is not None
    assert loss == pytest.approx(float(expected.detach()))
    torch.testing.assert_close(gradient, at.grad[chosen])


@each_case
def test_adam_is_that_of_torch_with_a_cosine(case: Case) -> None:
    steps, rate = 12, 0.05
    point = case.theta.requires_grad_()
    adam = torch.optim.Adam([point], lr=rate)
    for step in range(steps):
        adam.param_groups[0]["lr"] = rate * (1 + math.cos(math.pi * step / steps)) / 2
        adam.zero_grad()
        half_square(case.formula, point).backward()
        adam.step()
    solution = Adam(rate).run(case.at, case.theta, StopRule(steps))
    torch.testing.assert_close(solution.theta, point.detach(), rtol=1e-9, atol=1e-12)
    rates = [rate * (1 + math.cos(math.pi * step / steps)) / 2 for step in range(steps)]
    assert [record.length for record in solution.history] == pytest.approx(rates)
    assert {(record.damping, record.gain_ratio) for record in solution.history} == {(0.0, 0.0)}


def test_adam_keeps_the_means_of_parameters_that_rest() -> None:
    """Turn by turn, each parameter moves as if the other steps had had no gradient for it."""
    problem, _ = random_problem(5)
    steps = 9

    def turns(number: int, theta: Tensor) -> Plain:
        return Plain(problem.formula, theta, torch.tensor([[0, 2], [3, 1]][number % 2]))

    theta = torch.ones(4, dtype=F64)
    m, v = torch.zeros(4, dtype=F64), torch.zeros(4, dtype=F64)
    for number in range(1, steps + 1):
        at = theta.clone().requires_grad_()
        half_square(problem.formula, at).backward()
        assert at.grad is not None
        free = torch.zeros(4, dtype=F64)
        free[[[0, 2], [3, 1]][number % 2]] = 1.0
        g = at.grad * free
        m, v = 0.9 * m + 0.1 * g, 0.999 * v + 0.001 * g**2
        rate = 0.1 * (1 + math.cos(math.pi * (number - 1) / steps)) / 2
        step = rate * (m / (1 - 0.9**number)) / ((v / (1 - 0.999**number)).sqrt() + 1e-8)
        theta = theta - step * free
    solution = Adam(0.1).run(turns, torch.ones(4, dtype=F64), StopRule(steps))
    torch.testing.assert_close(solution.theta, theta)


def test_adam_does_not_stop_where_it_goes_uphill() -> None:
    case = CASES["rosenbrock"]
    solution = Adam(0.5).run(case.at, case.theta, StopRule(30, tolerance=0.5, patience=1))
    assert any(record.loss > record.before for record in solution.history)
    assert solution.status == "Stopped at the limit of 30 steps."


@each_case
def test_lbfgs_is_that_of_torch_over_all_outer_steps(case: Case) -> None:
    """The pairs are kept, so that outer steps on one problem are pieces of one run."""
    inner, outer = 3, 2
    point = case.theta.requires_grad_()
    scale = 1 / float(half_square(case.formula, case.theta))
    # Evaluations are limited by torch in each piece, the oracle's too.
    torch_lbfgs = torch.optim.LBFGS(
        [point], max_iter=inner, tolerance_grad=0.0, tolerance_change=0.0, line_search_fn="strong_wolfe"
    )

    def closure() -> Tensor:
        torch_lbfgs.zero_grad()
        loss = scale * half_square(case.formula, point)
        loss.backward()
        return loss.detach()

    for _ in range(outer):
        torch_lbfgs.step(closure)
    solution = LBFGS(inner=inner).run(case.at, case.theta, StopRule(outer))
    torch.testing.assert_close(solution.theta, point.detach(), rtol=1e-6, atol=1e-9)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**31), st.sampled_from([1e-6, 1.0, 1e6]))
def test_lbfgs_solves_linear_problems_of_any_scale(seed: int, scale: float) -> None:
    problem, best = random_problem(seed, scale)
    solution = LBFGS().run(lambda _, t: Plain(problem.formula, t), problem.theta, StopRule(8, tolerance=0.0))
    torch.testing.assert_close(solution.theta, best, rtol=0, atol=1e-6)


def lbfgs_path(problems: list[Plain], start: Tensor, anew: bool) -> Tensor:
    """Parameters after an outer step on each problem, posed where the one before ended, in one run or one run each."""

    def posed(number: int, theta: Tensor) -> Plain:
        return replace(problems[number - 1], theta=theta)

    optimiser = LBFGS(inner=4)
    if not anew:
        return optimiser.run(posed, start, StopRule(len(problems), tolerance=0.0, patience=99)).theta
    for number in range(1, len(problems) + 1):
        start = optimiser.run(lambda _, theta, number=number: posed(number, theta), start, StopRule(1)).theta
    return start


def test_lbfgs_keeps_pairs_while_the_same_parameters_are_free() -> None:
    problem, best = random_problem(11)
    kept = lbfgs_path([problem] * 2, problem.theta, anew=False)
    dropped = lbfgs_path([problem] * 2, problem.theta, anew=True)
    assert float((kept - best).norm()) < 0.2 * float((dropped - best).norm())


def test_lbfgs_drops_pairs_of_other_parameters_however_many() -> None:
    problem, _ = random_problem(11)
    turns = [replace(problem, chosen=torch.tensor(places)) for places in ([0, 1, 2], [1, 2, 3], [3, 2, 1])]
    once, anew = (lbfgs_path(turns, problem.theta, anew) for anew in (False, True))
    torch.testing.assert_close(once, anew, rtol=0, atol=0)


def test_lbfgs_drops_pairs_that_led_nowhere() -> None:
    problem, _ = random_problem(11)
    # Its gradient is zero, so that the step on it lowers nothing.
    flat = Plain(lambda x: 1.0 + 0.0 * x, problem.theta)
    once, anew = (lbfgs_path([problem, flat, problem], problem.theta, anew) for anew in (False, True))
    torch.testing.assert_close(once, anew, rtol=0, atol=0)


def test_lbfgs_turns_back_from_losses_that_are_not_finite() -> None:
    """A logarithm's residual has none below zero, where the first trial of the line lands."""
    start, asked = torch.tensor([0.01, 3.0], dtype=F64), []

    def formula(theta: Tensor) -> Tensor:
        asked.append(bool((theta <= 0).any()))
        return torch.stack([10.0 * theta[0].log(), theta[1].log() + 0.1 * theta[0]])

    solution = LBFGS(learning_rate=200.0).run(lambda _, t: Plain(formula, t), start, StopRule(40, tolerance=1e-9))
    assert any(asked), "the line search should have gone too far"
    best = torch.tensor([1.0, math.exp(-0.1)], dtype=F64)
    torch.testing.assert_close(solution.theta, best, rtol=0, atol=1e-6)


def test_lbfgs_stays_where_nothing_is_lower() -> None:
    case = CASES["circle, residual left"]
    solution = LBFGS().run(case.at, case.best, StopRule(20, patience=3))
    assert solution.status == "No step lowered the loss."
    assert [record.length for record in solution.history] == [0.0] * 3
    assert torch.equal(solution.theta, case.best)


def test_lbfgs_lowers_each_sample_when_points_are_fresh() -> None:
    def problem_at(number: int, theta: Tensor) -> Plain:
        generator = torch.Generator().manual_seed(number)
        J = torch.randn(30, 4, generator=generator, dtype=F64)
        noise = 0.1 * torch.randn(30, generator=generator, dtype=F64)
        return Plain(lambda x: (J @ (x - 1.0)).sin() + noise, theta)

    start = torch.full((4,), 1.3, dtype=F64)
    solution = LBFGS(inner=5).run(problem_at, start, StopRule(10, tolerance=0.0, patience=11))
    assert all(record.loss <= record.before for record in solution.history)
    assert sum(record.length for record in solution.history) >= 8
    assert loss_of(problem_at(99, start), solution.theta) < 0.2 * loss_of(problem_at(99, start), start)
