"""The Gauss-Newton loop: when it has converged, and that what a search began leaves no trace when it is interrupted."""

from __future__ import annotations

import pytest
import torch
from least_squares_problems import CASES, Plain, rosenbrock
from torch import Tensor

from gnrecon.least_squares import DenseJacobian
from gnrecon.optim import GainRatioDamping, GaussNewton, LogLineSearch, Search, StopRule

ROSENBROCK = CASES["rosenbrock"]
each_search = pytest.mark.parametrize(
    "search",
    [GainRatioDamping(), GainRatioDamping(geodesic=True), LogLineSearch()],
    ids=["damping", "geodesic", "line"],
)


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
    solution = GaussNewton(search).run(ROSENBROCK.at, ROSENBROCK.best, StopRule(steps=50, patience=3))
    assert solution.status == "Converged after 3 steps."
    assert torch.equal(solution.theta, ROSENBROCK.best)


@each_search
def test_no_step_from_a_point_that_nothing_lowers(search: Search) -> None:
    case = CASES["circle, residual left"]
    solution = GaussNewton(search).run(case.at, case.best, StopRule(steps=50, patience=3))
    assert solution.status == "No step lowered the loss."
    assert torch.equal(solution.theta, case.best)


@each_search
def test_no_residuals_or_parameters_are_said(search: Search) -> None:
    class Empty(Plain):
        def linearise(self, free: Tensor) -> tuple[DenseJacobian, Tensor]:
            return DenseJacobian(free.new_zeros(0, len(free))), free.new_zeros(0)

    none = GaussNewton(search).run(
        lambda _, theta: Empty(lambda t: t[:0], theta), ROSENBROCK.theta, StopRule(patience=2)
    )
    assert none.status == "Converged after 2 steps. There are no residuals to lower."
    fixed = GaussNewton(search).run(
        lambda _, theta: Plain(rosenbrock, theta, torch.arange(0)), ROSENBROCK.theta, StopRule(patience=2)
    )
    assert fixed.status == "No step lowered the loss. There are no free parameters."


@each_search
@pytest.mark.parametrize("last", range(3, 12))
def test_interrupt_at_any_residual_keeps_the_last_finished_step(search: Search, last: int) -> None:
    calls = 0

    def interrupted(theta: Tensor) -> Tensor:
        nonlocal calls
        calls += 1
        if calls == last:
            raise KeyboardInterrupt
        return rosenbrock(theta)

    solution = GaussNewton(search).run(lambda _, theta: Plain(interrupted, theta), ROSENBROCK.theta, StopRule())
    assert solution.interrupted
    finished = GaussNewton(search).run(ROSENBROCK.at, ROSENBROCK.theta, StopRule(steps=len(solution.history)))
    assert torch.equal(solution.theta, finished.theta)
