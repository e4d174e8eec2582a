"""Gauss-Newton reaches every minimum with every linear solver, and tells what the solver did."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
import torch
from least_squares_problems import CASES, Case
from torch import Tensor

from gnrecon.least_squares import SOLVERS, Cholesky, DampedSystem, Jacobian, Metric, Step, identity
from gnrecon.optim import GainRatioDamping, GaussNewton, LogLineSearch, StopRule

DENSE = [name for name in SOLVERS if name != "cg-kronecker"]
"""That one needs the outer products of a network's layers."""


@pytest.mark.parametrize("name", DENSE)
@pytest.mark.parametrize("case", CASES.values(), ids=CASES.keys())
def test_every_solver_reaches_every_minimum(name: str, case: Case) -> None:
    # The row-space form needs a metric that is the same for all parameters.
    solution = GaussNewton(GainRatioDamping(metric=identity, geodesic=True), SOLVERS[name]()).run(
        case.at, case.theta, StopRule(steps=40, tolerance=1e-8)
    )
    torch.testing.assert_close(solution.theta, case.best, rtol=0, atol=case.tolerance)


@pytest.mark.parametrize("search", [GainRatioDamping(), LogLineSearch()])
def test_iterations_of_the_solver_are_in_the_records(search: GainRatioDamping | LogLineSearch) -> None:
    case = CASES["exponential fit"]
    direct = GaussNewton(search, SOLVERS["cholesky"]()).run(case.at, case.theta, StopRule(3))
    assert [record.iterations for record in direct.history] == [0, 0, 0]
    iterative = GaussNewton(search, SOLVERS["cg-jacobi"]()).run(case.at, case.theta, StopRule(3))
    assert all(record.iterations >= 3 for record in iterative.history), "three parameters take three iterations"


@pytest.mark.parametrize("name", DENSE)
def test_the_solver_describes_itself_at_the_end(name: str) -> None:
    case, solver = CASES["rosenbrock"], SOLVERS[name]()
    run = GaussNewton(GainRatioDamping(metric=identity), solver).run(case.at, case.theta, StopRule(2))
    assert run.method == f"{GainRatioDamping().describe()} {solver.describe()}"


@dataclass(frozen=True)
class Failing:
    """A solver that finds no step."""

    def linearise(self, jacobian: Jacobian, residual: Tensor, metric: Metric) -> DampedSystem:
        @dataclass(frozen=True)
        class Nothing:
            whole = Cholesky().linearise(jacobian, residual, metric)
            equations, loss = whole.equations, whole.loss

            def solve(self, damping: float, residual: Tensor | None = None) -> Step:
                del damping, residual
                return self.equations.failed("The cat ate it.")

        return Nothing()

    def describe(self) -> str:
        return "None."


@pytest.mark.parametrize("search", [GainRatioDamping(), GainRatioDamping(geodesic=True), LogLineSearch()])
def test_the_sentence_of_a_solver_that_failed_ends_the_status(search: GainRatioDamping | LogLineSearch) -> None:
    case = CASES["rosenbrock"]
    solution = GaussNewton(search, Failing()).run(case.at, case.theta, StopRule())
    assert solution.status == "No step lowered the loss. The cat ate it."
    assert torch.equal(solution.theta, case.theta)
