"""What all searches have in common: every one solves every problem, and none moves where no step can be meant."""

from __future__ import annotations

import pytest
import torch
from least_squares_problems import CASES, Case, Plain, rosenbrock
from scripted import Scripted, posed
from torch import Tensor

from gnrecon.least_squares import Cholesky, DenseJacobian, identity, jacobian_scaled, layer_scaled
from gnrecon.optim import FixedStep, GainRatioDamping, GaussNewton, LogLineSearch, Search, StopRule
from gnrecon.optim.problem import loss_of

SEARCHES: dict[str, Search] = {
    "Marquardt": GainRatioDamping(),
    "Levenberg": GainRatioDamping(metric=identity),
    "by layers": GainRatioDamping(metric=layer_scaled),
    "geodesic": GainRatioDamping(geodesic=True),
    "geodesic, Levenberg": GainRatioDamping(geodesic=True, metric=identity),
    "heavily damped start": GainRatioDamping(initial_damping=1e3),
    "line": LogLineSearch(),
    "line, Marquardt's metric": LogLineSearch(metric=jacobian_scaled),
    "fixed": FixedStep(0.2),
}
each_search = pytest.mark.parametrize("search", SEARCHES.values(), ids=SEARCHES.keys())


@each_search
@pytest.mark.parametrize("case", CASES.values(), ids=CASES.keys())
def test_every_search_solves_every_problem(search: Search, case: Case) -> None:
    steps = 100 if isinstance(search, FixedStep) else 40
    solution = GaussNewton(search).run(case.at, case.theta, StopRule(steps, tolerance=1e-10))
    torch.testing.assert_close(solution.theta, case.best, rtol=0, atol=case.tolerance)
    assert solution.history[-1].loss == pytest.approx(loss_of(case.at(1, solution.theta), solution.theta), abs=1e-30)
    if not isinstance(search, FixedStep):
        assert all(record.loss <= record.before for record in solution.history)


@each_search
def test_a_system_that_cannot_be_solved_is_not_a_crash(search: Search) -> None:
    problem, _, theta = posed(search)
    broken = DenseJacobian(torch.full((2, 2), torch.nan, dtype=torch.float64))
    system = Cholesky().linearise(broken, torch.ones(2, dtype=torch.float64), search.metric)
    move = search.advance(problem, system, theta, search.initial_damping)
    assert torch.equal(move.free, theta)
    assert move.length == 0.0
    assert move.next_damping > search.initial_damping
    assert move.failure == "The Jacobian or the residuals are not finite."


@each_search
def test_a_stationary_point_is_kept_whatever_the_rounding(search: Search) -> None:
    theta = torch.zeros(1, dtype=torch.float64)
    # J vanishes, and the loss summed in another order falls by a rounding error: no step can be meant by that.
    residual = torch.tensor([(1.0 + 2e-16) ** 0.5], dtype=torch.float64)
    system = Cholesky().linearise(DenseJacobian(theta[:, None]), residual, search.metric)
    problem = Scripted(Plain(lambda t: t, theta), [0.5 - 1e-16] * 15)
    move = search.advance(problem, system, theta, search.initial_damping)
    assert torch.equal(move.free, theta)


@each_search
def test_parameters_in_float32_stay_so(search: Search) -> None:
    """J and the solve may be in float64 all the same."""

    class Mixed(Plain):
        def linearise(self, free: Tensor) -> tuple[DenseJacobian, Tensor]:
            jacobian, residual = super().linearise(free)
            return DenseJacobian(jacobian.matrix.double()), residual

    solution = GaussNewton(search).run(
        lambda _, theta: Mixed(rosenbrock, theta), CASES["rosenbrock"].theta.float(), StopRule(steps=200)
    )
    assert solution.theta.dtype == torch.float32
    torch.testing.assert_close(solution.theta, torch.ones(2), rtol=0, atol=2e-2)


def test_searches_describe_themselves() -> None:
    sentences = {search.describe() for search in (GainRatioDamping(), GainRatioDamping(geodesic=True), LogLineSearch())}
    sentences.add(FixedStep(length=0.25).describe())
    assert len(sentences) == 4
    assert all(sentence.startswith("Gauss-Newton") and sentence.endswith(".") for sentence in sentences)
    assert "0.25" in FixedStep(length=0.25).describe()
