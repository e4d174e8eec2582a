"""Every search on every problem reaches the minimum, and a trial that lost leaves no trace."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import pytest
import torch
from least_squares import CASES, Case, Plain, rosenbrock
from torch import Tensor

from gnrecon.linalg import identity, jacobian_scaled, normal_equations
from gnrecon.linalg.damped import DampedSystem
from gnrecon.optim import GainRatioDamping, GaussNewton, LogLineSearch, Search, StopRule
from gnrecon.optim.problem import loss_of

SEARCHES: dict[str, Search] = {
    "Marquardt": GainRatioDamping(),
    "Levenberg": GainRatioDamping(metric=identity),
    "heavily damped start": GainRatioDamping(initial_damping=1e3),
    "line": LogLineSearch(),
    "line, Marquardt's metric": LogLineSearch(metric=jacobian_scaled),
}
each_search = pytest.mark.parametrize("search", SEARCHES.values(), ids=SEARCHES.keys())


@each_search
@pytest.mark.parametrize("case", CASES.values(), ids=CASES.keys())
def test_every_search_solves_every_problem(search: Search, case: Case) -> None:
    solution = GaussNewton(search).run(case.at, case.theta, StopRule(steps=100, tolerance=1e-10))
    minimum = torch.tensor(case.minimum, dtype=torch.float64)
    torch.testing.assert_close(solution.theta, minimum, rtol=0, atol=case.tolerance)
    assert all(record.loss <= record.before for record in solution.history)
    assert solution.history[-1].loss == pytest.approx(loss_of(case.at(1, solution.theta), solution.theta), abs=1e-30)


@dataclass
class Watched:
    """A problem that notes down what it was asked for, with losses that follow a script where there is one."""

    inner: Plain
    asked: list[Tensor] = field(default_factory=list)
    script: list[float] = field(default_factory=list)

    def free(self) -> Tensor:
        return self.inner.free()

    def whole(self, free: Tensor) -> Tensor:
        return self.inner.whole(free)

    def residual(self, free: Tensor) -> Tensor:
        self.asked.append(free.clone())
        if self.script:
            return torch.tensor([math.sqrt(2 * self.script[len(self.asked) - 1])], dtype=free.dtype)
        return self.inner.residual(free)

    def chunks(self, free: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
        return self.inner.chunks(free)


def posed(search: Search, script: list[float] | None = None) -> tuple[Watched, DampedSystem, Tensor]:
    theta = CASES["rosenbrock"].theta
    problem = Watched(Plain(rosenbrock, theta), script=script or [])
    return problem, normal_equations(problem.chunks(theta), 2, theta, search.metric), theta


def test_line_search_tries_log_spaced_lengths_from_one_start() -> None:
    search = LogLineSearch(trials=15)
    problem, system, theta = posed(search)
    move = search.advance(problem, system, theta, search.initial_damping)
    step = system.solve(search.initial_damping)
    assert step is not None
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


def test_gain_ratio_damping_takes_the_first_improvement_and_eases() -> None:
    search = GainRatioDamping(initial_damping=1e-2)
    problem, system, theta = posed(search, [1e6, math.nan, 1.0, 0.5])
    move = search.advance(problem, system, theta, 1e-2)
    assert len(problem.asked) == 3
    # Two rejections: by 2, then by 4.
    assert move.damping == pytest.approx(8e-2)
    step = system.solve(move.damping)
    assert step is not None
    assert torch.equal(move.free, theta + step.direction)
    assert move.gain_ratio == pytest.approx((system.loss - 1.0) / step.predicted)
    easing = max(1 / 3, 1 - (2 * min(move.gain_ratio, 1.0) - 1) ** 3)
    assert move.next_damping == pytest.approx(move.damping * easing)


def test_gain_ratio_damping_gives_up_where_it_was() -> None:
    search = GainRatioDamping(trials=4)
    problem, system, theta = posed(search, [1e6, math.inf, math.nan, 50.0])
    move = search.advance(problem, system, theta, 1e-3)
    assert torch.equal(move.free, theta)
    assert (move.loss, move.length) == (system.loss, 0.0)
    assert move.next_damping > 1e-3


def test_damping_has_a_floor() -> None:
    search = GainRatioDamping(smallest=1e-5)
    problem, system, theta = posed(search)
    assert search.advance(problem, system, theta, 1e-5).next_damping >= 1e-5


@each_search
def test_a_system_that_cannot_be_solved_is_not_a_crash(search: Search) -> None:
    problem, _, theta = posed(search)
    broken = [(torch.full((2, 2), torch.nan, dtype=torch.float64), torch.ones(2, dtype=torch.float64))]
    system = normal_equations(broken, 2, theta, search.metric)
    move = search.advance(problem, system, theta, search.initial_damping)
    assert torch.equal(move.free, theta)
    assert move.length == 0.0
    assert move.next_damping > search.initial_damping


@each_search
def test_a_stationary_point_is_kept_whatever_the_rounding(search: Search) -> None:
    theta = torch.zeros(1, dtype=torch.float64)
    # J vanishes, and the loss summed in another order falls by a rounding error: no step can be meant by that.
    system = DampedSystem(theta[:, None], theta, search.metric(theta), 0.5 + 1e-16)
    problem = Watched(Plain(lambda t: t, theta), script=[0.5 - 1e-16] * 15)
    move = search.advance(problem, system, theta, search.initial_damping)
    assert torch.equal(move.free, theta)
