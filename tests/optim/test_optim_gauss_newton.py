"""The loop: when it stops and why, what it tells, and what it keeps when it is interrupted."""

from __future__ import annotations

import pytest
import torch
from least_squares import CASES, Plain, circle_fit, exponential_fit, rosenbrock
from torch import Tensor

from gnrecon.optim import GainRatioDamping, GaussNewton, LogLineSearch, Record, Search, StopRule

ROSENBROCK = CASES["rosenbrock"]
each_search = pytest.mark.parametrize("search", [GainRatioDamping(), LogLineSearch()], ids=["damping", "line"])


@each_search
def test_step_limit(search: Search) -> None:
    records: list[Record] = []
    solution = GaussNewton(search).run(ROSENBROCK.at, ROSENBROCK.theta, StopRule(steps=2), records.append)
    assert solution.status == "Stopped at the limit of 2 steps."
    assert not solution.interrupted
    assert [record.step for record in solution.history] == [1, 2]
    assert tuple(records) == solution.history
    assert records[1].before == pytest.approx(records[0].loss)


def test_no_steps_leave_the_start() -> None:
    solution = GaussNewton(GainRatioDamping()).run(ROSENBROCK.at, ROSENBROCK.theta, StopRule(steps=0))
    assert torch.equal(solution.theta, ROSENBROCK.theta)
    assert solution.history == ()


@each_search
@pytest.mark.parametrize("patience", [1, 2, 4])
def test_patience(search: Search, patience: int) -> None:
    case = CASES["circle, residual left"]
    solution = GaussNewton(search).run(case.at, case.theta, StopRule(steps=60, tolerance=1e-2, patience=patience))
    idle = [record.loss > 0.99 * record.before for record in solution.history]
    assert solution.status == f"Converged after {len(idle)} steps."
    assert all(idle[-patience:])
    runs = "".join("i" if one else "." for one in idle[:-1])
    assert "i" * patience not in runs, "it should have stopped sooner"


@each_search
def test_a_problem_already_solved_converges_at_once(search: Search) -> None:
    minimum = torch.tensor(ROSENBROCK.minimum, dtype=torch.float64)
    solution = GaussNewton(search).run(ROSENBROCK.at, minimum, StopRule(steps=50, patience=3))
    assert solution.status == "Converged after 3 steps."
    assert torch.equal(solution.theta, minimum)


@each_search
def test_some_parameters_free(search: Search) -> None:
    """With the rate held fixed, amplitude and offset of the decay are a linear problem."""
    theta = torch.tensor([1.0, 0.7, 0.0], dtype=torch.float64)
    chosen = torch.tensor([2, 0])
    solution = GaussNewton(search).run(
        lambda _, theta: Plain(exponential_fit, theta, chosen), theta, StopRule(steps=20, tolerance=1e-12)
    )
    assert float(solution.theta[1]) == 0.7
    torch.testing.assert_close(solution.theta, torch.tensor([2.0, 0.7, -0.3], dtype=torch.float64))


def test_subspaces_that_change_from_step_to_step_reach_the_joint_minimum() -> None:
    def problem_at(number: int, theta: Tensor) -> Plain:
        return Plain(circle_fit, theta, torch.tensor([number % 2]))

    start = torch.tensor([0.7, 0.4], dtype=torch.float64)
    solution = GaussNewton(GainRatioDamping()).run(problem_at, start, StopRule(steps=60, tolerance=0, patience=61))
    assert [record.step for record in solution.history] == list(range(1, 61))
    torch.testing.assert_close(solution.theta, torch.zeros(2, dtype=torch.float64), rtol=0, atol=1e-4)


def finished(steps: int) -> Tensor:
    return GaussNewton(GainRatioDamping()).run(ROSENBROCK.at, ROSENBROCK.theta, StopRule(steps=steps)).theta


def test_interrupt_in_the_callback_keeps_the_finished_step() -> None:
    def callback(record: Record) -> None:
        if record.step == 3:
            raise KeyboardInterrupt

    solution = GaussNewton(GainRatioDamping()).run(ROSENBROCK.at, ROSENBROCK.theta, StopRule(), callback)
    assert solution.interrupted
    assert solution.status == "Interrupted after 3 steps."
    assert len(solution.history) == 3
    assert torch.equal(solution.theta, finished(3))


def test_interrupt_within_a_step_keeps_the_last_finished_one() -> None:
    def problem_at(number: int, theta: Tensor) -> Plain:
        if number == 4:
            raise KeyboardInterrupt
        return ROSENBROCK.at(number, theta)

    solution = GaussNewton(GainRatioDamping()).run(problem_at, ROSENBROCK.theta, StopRule())
    assert solution.interrupted
    assert len(solution.history) == 3
    assert torch.equal(solution.theta, finished(3))


def test_interrupt_at_a_residual_keeps_the_last_finished_step() -> None:
    calls = 0

    def interrupted(theta: Tensor) -> Tensor:
        nonlocal calls
        calls += 1
        if calls == 12:
            raise KeyboardInterrupt
        return rosenbrock(theta)

    solution = GaussNewton(GainRatioDamping()).run(
        lambda _, theta: Plain(interrupted, theta), ROSENBROCK.theta, StopRule()
    )
    assert solution.interrupted
    assert torch.equal(solution.theta, finished(len(solution.history)))


@each_search
@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_a_loss_that_is_not_finite_ends_with_a_sentence(search: Search, bad: float) -> None:
    def problem_at(number: int, theta: Tensor) -> Plain:
        return Plain(lambda t: rosenbrock(t) + (bad if number == 3 else 0.0), theta)

    solution = GaussNewton(search).run(problem_at, ROSENBROCK.theta, StopRule())
    assert solution.status == "The loss was not finite at step 3."
    assert not solution.interrupted
    assert len(solution.history) == 2
    assert bool(solution.theta.isfinite().all())
