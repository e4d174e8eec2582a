"""Gain-ratio damping: which trial is taken, what becomes of the damping, and how a step bends with the residuals."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from least_squares_problems import CASES, Plain, rosenbrock
from scripted import Scripted, posed
from torch import Tensor
from torch.func import jacrev

from gnrecon.least_squares import Cholesky, Iterative, Metric, Step, identity, jacobian_scaled
from gnrecon.optim import GainRatioDamping, GaussNewton, StopRule

F64 = torch.float64


@pytest.mark.parametrize(
    ("script", "rejections"),
    [([1.0], []), ([math.nan, 1.0], [2.0]), ([1e6, math.nan, 1.0], [2.0, 4.0])],
)
@pytest.mark.parametrize("shortened", [False, True])
def test_the_first_improvement_is_taken_and_eases_the_damping(
    script: list[float], rejections: list[float], shortened: bool
) -> None:
    search = GainRatioDamping(initial_damping=1e-2, least_share=0.1 if shortened else 1.0)
    if shortened:
        # A loss that is finite and no lower is asked for once more, at a share of the step.
        script = [loss for asked in script for loss in ([asked, asked] if asked == 1e6 else [asked])]
    problem, system, theta = posed(search, [*script, 0.5])
    move = search.advance(problem, system, theta, 1e-2)
    assert len(problem.asked) == len(script)
    assert move.damping == pytest.approx(math.prod(rejections, start=1e-2))
    step = system.solve(move.damping)
    assert torch.equal(move.free, theta + step.direction)
    assert move.length == 1.0
    assert move.gain_ratio == pytest.approx((system.loss - 1.0) / step.predicted)
    easing = max(1 / 3, 1 - (2 * min(move.gain_ratio, 1.0) - 1) ** 3)
    assert move.next_damping == pytest.approx(move.damping * easing)


@pytest.mark.parametrize(("rise", "share"), [(1e6, 0.1), (0.0, 0.5), (1e-9, 0.5), (30.0, None)])
def test_where_the_loss_rises_a_shorter_step_is_tried_before_the_damping_rises(
    rise: float, share: float | None
) -> None:
    search = GainRatioDamping(initial_damping=1e-2, least_share=0.1)
    problem, system, theta = posed(search)
    step = system.solve(1e-2)
    slope = float(step.direction @ system.equations.gradient)
    # The parabola l + slope t + (rise - slope) t^2 is least where its derivative vanishes.
    wanted = share or -slope / (2 * (rise - slope))
    assert 0.1 <= wanted <= 0.5
    problem.script[:] = [system.loss + rise, system.loss - 1.0]
    move = search.advance(problem, system, theta, 1e-2)
    assert move.length == pytest.approx(wanted)
    assert (move.damping, move.next_damping) == (1e-2, 2e-2)
    torch.testing.assert_close(move.free, theta + wanted * step.direction)
    assert torch.equal(move.free, problem.asked[-1]), "the parameters whose loss was found"
    J = system.equations.jacobian
    linear = system.equations.residual + wanted * J.mv(step.direction)
    assert move.gain_ratio == pytest.approx(1.0 / (system.loss - 0.5 * float(linear @ linear)))


def test_a_share_of_the_accepted_step_is_gone() -> None:
    search = GainRatioDamping(initial_damping=1e-2, length=0.25)
    problem, system, theta = posed(search, [1.0, 2.0])
    move = search.advance(problem, system, theta, 1e-2)
    step = system.solve(move.damping)
    torch.testing.assert_close(move.free, theta + 0.25 * step.direction)
    assert (move.loss, move.length) == (2.0, 0.25)
    assert move.gain_ratio == pytest.approx((system.loss - 1.0) / step.predicted), "that of the whole step"


def test_it_gives_up_where_it_was() -> None:
    search = GainRatioDamping(trials=4)
    problem, system, theta = posed(search, [1e6, math.inf, math.nan, 50.0])
    move = search.advance(problem, system, theta, 1e-3)
    assert torch.equal(move.free, theta)
    assert (move.loss, move.length) == (system.loss, 0.0)
    assert move.next_damping > 1e-3
    assert move.failure is None, "every system was solved"


def test_damping_has_a_floor() -> None:
    search = GainRatioDamping(smallest=1e-5)
    problem, system, theta = posed(search)
    assert search.advance(problem, system, theta, 1e-5).next_damping >= 1e-5


@pytest.mark.parametrize("geodesic", [False, True])
def test_iterations_of_all_solves_are_counted(geodesic: bool) -> None:
    search = GainRatioDamping(initial_damping=1e-2, geodesic=geodesic)
    problem, _, theta = posed(search)
    system = Iterative("cg").linearise(*problem.linearise(theta), search.metric)
    counts: list[int] = []
    solve = system.solve

    class Counting:
        equations, loss = system.equations, system.loss

        def solve(self, damping: float, residual: Tensor | None = None) -> Step:
            step = solve(damping, residual)
            counts.append(step.iterations)
            return step

    move = search.advance(problem, Counting(), theta, 1e-2)  # type: ignore[arg-type]
    assert len(counts) >= 1 + geodesic
    assert move.iterations == sum(counts) > 0


def quadratic(seed: int, bend: float) -> Plain:
    """Residuals r + J x + x.H x / 2 about zero, whose second derivative is the same everywhere."""
    generator = torch.Generator().manual_seed(seed)
    r, J = torch.randn(7, generator=generator, dtype=F64), torch.randn(7, 4, generator=generator, dtype=F64)
    H = bend * torch.randn(7, 4, 4, generator=generator, dtype=F64)
    return Plain(lambda x: r + J @ x + 0.5 * torch.einsum("nij,i,j->n", H, x, x), torch.zeros(4, dtype=F64))


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**31), st.sampled_from([1e-2, 1.0, 30.0]), st.sampled_from([identity, jacobian_scaled]))
def test_a_step_bends_by_the_second_derivative(seed: int, damping: float, metric: Metric) -> None:
    search = GainRatioDamping(geodesic=True, metric=metric, trials=1)
    problem = Scripted(quadratic(seed, 0.05))
    theta = problem.free()
    jacobian, r = problem.linearise(theta)
    system = Cholesky().linearise(jacobian, r, search.metric)
    search.advance(problem, system, theta, damping)

    J = jacrev(problem.inner.residual)(theta)
    damped = J.T @ J + damping * torch.diag(search.metric(jacobian))
    s = -torch.linalg.solve(damped, J.T @ r)
    # r_ss by differentiating twice
    r_ss = torch.einsum("nij,i,j->n", jacrev(jacrev(problem.inner.residual))(theta), s, s)
    a = -torch.linalg.solve(damped, J.T @ r_ss)
    # Where it bends too much there is no trial: see test_a_trial_that_bends_too_much_is_refused.
    D = search.metric(jacobian)
    assume(float(D @ a.square()) < 0.5 * float(D @ s.square()))
    torch.testing.assert_close(problem.asked[-1] - theta - s, a / 2, rtol=1e-6, atol=1e-11)


def test_the_correction_is_of_second_order() -> None:
    """Residuals y - x^2 and x, with next to no damping: the bent step ends at their common zero."""
    theta = torch.tensor([1.0, 2.0], dtype=F64)
    problem = Plain(lambda t: torch.stack([t[1] - t[0] ** 2, t[0]]), theta)
    search = GainRatioDamping(geodesic=True, metric=identity, trials=1)
    system = Cholesky().linearise(*problem.linearise(theta), identity)
    # s = (-1, -3) and r_ss = (-2, 0), so that a = (0, 2) and s + a / 2 = (-1, -2).
    move = search.advance(problem, system, theta, 1e-13)
    torch.testing.assert_close(move.free, torch.zeros(2, dtype=F64), rtol=0, atol=1e-9)
    straight = GainRatioDamping(metric=identity, trials=1).advance(problem, system, theta, 1e-13)
    torch.testing.assert_close(straight.free, torch.tensor([0.0, -1.0], dtype=F64), rtol=0, atol=1e-9)


def test_a_step_that_bends_goes_as_far_as_its_model() -> None:
    plain = quadratic(3, 10.0)
    problem, theta = Scripted(plain), plain.free()
    search = GainRatioDamping(geodesic=True, trials=1, least_share=0.1)
    system = Cholesky().linearise(*plain.linearise(theta), search.metric)
    move = search.advance(problem, system, theta, 1e-3)
    s = system.solve(1e-3).direction
    t = move.length
    assert search.least_share < t < 0.5
    # The last place asked for is theta + t s + t^2 a / 2.
    a = (problem.asked[-1] - theta - t * s) * (2 / t**2)
    D = system.equations.metric
    assert float(D @ (t**2 * a).square()) == pytest.approx(0.75**2 * float(D @ (t * s).square()), rel=1e-6)
    assert move.loss < system.loss
    assert move.next_damping == 2e-3


@pytest.mark.parametrize("bend", [0.05, 200.0])
def test_a_trial_that_bends_too_much_is_refused(bend: float) -> None:
    plain = quadratic(3, bend)
    # Any loss would be taken if it were asked for: at theta + s / 10, then at the trial.
    problem = Scripted(plain)
    theta = plain.free()
    search = GainRatioDamping(geodesic=True, trials=1)
    system = Cholesky().linearise(*plain.linearise(theta), search.metric)
    move = search.advance(problem, system, theta, 1e-3)
    assert len(problem.asked) == (2 if bend < 1 else 1)
    assert (move.length > 0) == (bend < 1)
    assert torch.equal(move.free, theta) == (bend > 1)


def test_what_bends_too_much_is_damped_until_it_does_not() -> None:
    plain = quadratic(3, 200.0)
    search = GainRatioDamping(geodesic=True, trials=20)
    system = Cholesky().linearise(*plain.linearise(plain.free()), search.metric)
    move = search.advance(plain, system, plain.free(), 1e-3)
    assert move.length == 1.0
    assert move.damping > 1e-3
    assert move.loss < system.loss


def test_a_residual_that_is_not_finite_on_the_way_is_not_a_crash() -> None:
    search = GainRatioDamping(geodesic=True, trials=2)
    problem, system, theta = posed(search, [math.nan] * 4)
    move = search.advance(problem, system, theta, 1e-3)
    assert torch.equal(move.free, theta)
    assert move.length == 0.0


@pytest.mark.parametrize("metric", [identity, jacobian_scaled])
def test_bent_steps_come_sooner_through_a_bent_valley(metric: Metric) -> None:
    """Not from every single start, but over several."""

    def steps(geodesic: bool) -> int:
        search, total = GainRatioDamping(metric=metric, geodesic=geodesic), 0
        for start in [(-1.2, 1.0), (0.0, 5.0), (-5.0, 20.0)]:
            theta = torch.tensor(start, dtype=F64)
            run = GaussNewton(search).run(
                lambda _, t: Plain(rosenbrock, t), theta, StopRule(100, tolerance=1e-10, patience=1)
            )
            torch.testing.assert_close(run.theta, CASES["rosenbrock"].best, rtol=0, atol=1e-5)
            total += next(record.step for record in run.history if record.loss < 1e-12)
        return total

    assert steps(geodesic=True) < 0.9 * steps(geodesic=False)
