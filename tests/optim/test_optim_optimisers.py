"""What all optimisers share: minima, records, subspaces, interrupts, losses that are not finite, stop rules."""

from __future__ import annotations

from itertools import pairwise

import pytest
import torch
from least_squares_problems import CASES, Case, Plain, circle_fit, exponential_fit, rosenbrock
from torch import Tensor

from gnrecon.optim import (
    LBFGS,
    OPTIMISERS,
    Adam,
    FixedStep,
    GainRatioDamping,
    GaussNewton,
    LogLineSearch,
    Optimiser,
    Record,
    StopRule,
)
from gnrecon.optim.problem import loss_of

METHODS: dict[str, tuple[Optimiser, int]] = {
    "damping": (GaussNewton(GainRatioDamping()), 40),
    "geodesic": (GaussNewton(GainRatioDamping(geodesic=True)), 40),
    "line": (GaussNewton(LogLineSearch()), 40),
    "fixed": (GaussNewton(FixedStep(0.2)), 100),
    "adam": (Adam(1.0), 600),
    "lbfgs": (LBFGS(), 20),
}
"""Each optimiser, and steps in which it reaches the minimum of every case."""

each_optimiser = pytest.mark.parametrize("optimiser", [one for one, _ in METHODS.values()], ids=METHODS.keys())
ROSENBROCK = CASES["rosenbrock"]


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("case", CASES.values(), ids=CASES.keys())
def test_every_optimiser_reaches_every_minimum(name: str, case: Case) -> None:
    optimiser, steps = METHODS[name]
    solution = optimiser.run(case.at, case.theta, StopRule(steps, tolerance=1e-12))
    # Adam is still on its way along the valleys.
    atol = 0.1 if name == "adam" else case.tolerance
    torch.testing.assert_close(solution.theta, case.best, rtol=0, atol=atol)


@pytest.mark.parametrize("name", OPTIMISERS)
def test_the_table_makes_optimisers(name: str) -> None:
    optimiser = OPTIMISERS[name]()
    solution = optimiser.run(ROSENBROCK.at, ROSENBROCK.theta, StopRule(5))
    assert solution.history[-1].loss < solution.history[0].before
    assert solution.method == optimiser.describe()
    assert solution.method.endswith(".")


@each_optimiser
def test_records_tell_the_losses_of_each_step(optimiser: Optimiser) -> None:
    start, path = ROSENBROCK.theta, [ROSENBROCK.theta]
    records: list[Record] = []

    def problem_at(number: int, theta: Tensor) -> Plain:
        assert number == len(path)
        path.append(theta.clone())
        return ROSENBROCK.at(number, theta)

    solution = optimiser.run(problem_at, start, StopRule(steps=4), records.append)
    assert tuple(records) == solution.history
    assert solution.status == "Stopped at the limit of 4 steps."
    assert not solution.interrupted
    assert [record.step for record in records] == [1, 2, 3, 4]
    places = [*path[1:], solution.theta]
    losses = [loss_of(ROSENBROCK.at(1, place), place) for place in places]
    assert [record.before for record in records] == pytest.approx(losses[:-1])
    assert [record.loss for record in records] == pytest.approx(losses[1:])
    assert all(one.seconds <= other.seconds for one, other in pairwise(records))
    assert torch.equal(start, ROSENBROCK.theta), "the start must be left unchanged"


@each_optimiser
def test_no_steps_leave_the_start(optimiser: Optimiser) -> None:
    solution = optimiser.run(ROSENBROCK.at, ROSENBROCK.theta, StopRule(steps=0))
    assert torch.equal(solution.theta, ROSENBROCK.theta)
    assert solution.history == ()
    assert solution.status == "Stopped at the limit of 0 steps."


@pytest.mark.parametrize("name", METHODS)
def test_some_parameters_free(name: str) -> None:
    """With the rate held fixed, amplitude and offset of the decay are a linear problem; their order is not theta's."""
    optimiser, steps = METHODS[name]
    theta = torch.tensor([1.0, 0.7, 0.0], dtype=torch.float64)
    solution = optimiser.run(
        lambda _, theta: Plain(exponential_fit, theta, torch.tensor([2, 0])), theta, StopRule(steps, tolerance=1e-12)
    )
    assert float(solution.theta[1]) == 0.7
    best = torch.tensor([2.0, 0.7, -0.3], dtype=torch.float64)
    torch.testing.assert_close(solution.theta, best, rtol=0, atol=1e-5)


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("sizes", ["one by one", "one and all"])
def test_subspaces_that_change_from_step_to_step_reach_the_joint_minimum(name: str, sizes: str) -> None:
    def problem_at(number: int, theta: Tensor) -> Plain:
        odd = number % 2
        return Plain(circle_fit, theta, torch.tensor([odd]) if sizes == "one by one" else torch.arange(1 + odd))

    optimiser, steps = METHODS[name]
    steps = min(steps, 200)
    start = torch.tensor([0.7, 0.4], dtype=torch.float64)
    solution = optimiser.run(problem_at, start, StopRule(steps, tolerance=0.0, patience=steps + 1))
    assert [record.step for record in solution.history] == list(range(1, steps + 1))
    torch.testing.assert_close(solution.theta, torch.zeros(2, dtype=torch.float64), rtol=0, atol=1e-3)


@each_optimiser
def test_nothing_free_is_not_a_crash(optimiser: Optimiser) -> None:
    solution = optimiser.run(
        lambda _, theta: Plain(rosenbrock, theta, torch.arange(0)), ROSENBROCK.theta, StopRule(steps=4)
    )
    assert torch.equal(solution.theta, ROSENBROCK.theta)


@each_optimiser
def test_a_problem_posed_elsewhere_is_solved_from_there(optimiser: Optimiser) -> None:
    """Another method may have moved some parameters between two steps."""
    moved = torch.tensor([0.9, 0.8], dtype=torch.float64)
    solution = optimiser.run(lambda _, __: ROSENBROCK.at(1, moved), ROSENBROCK.theta, StopRule(steps=3))
    expected = loss_of(ROSENBROCK.at(1, moved), moved)
    assert [record.before for record in solution.history] == pytest.approx([expected] * 3)
    assert float((solution.theta - moved).norm()) < 1.0


def finished(optimiser: Optimiser, steps: int, of: int) -> Tensor:
    """Parameters after so many steps of a plan of more."""
    thetas: list[Tensor] = []
    optimiser.run(lambda n, t: (thetas.append(t.clone()), ROSENBROCK.at(n, t))[1], ROSENBROCK.theta, StopRule(of))
    return thetas[steps]


@each_optimiser
def test_interrupt_in_the_callback_keeps_the_finished_step(optimiser: Optimiser) -> None:
    def callback(record: Record) -> None:
        if record.step == 2:
            raise KeyboardInterrupt

    solution = optimiser.run(ROSENBROCK.at, ROSENBROCK.theta, StopRule(5), callback)
    assert solution.interrupted
    assert solution.status == "Interrupted after 2 steps."
    assert len(solution.history) == 2
    assert torch.equal(solution.theta, finished(optimiser, 2, of=5))


@each_optimiser
@pytest.mark.parametrize("call", [1, 2])
def test_interrupt_within_a_step_keeps_the_last_finished_one(optimiser: Optimiser, call: int) -> None:
    """At the first evaluation of the third step, which linearises, or at a later one, inside the step."""

    def problem_at(number: int, theta: Tensor) -> Plain:
        calls = 0

        def formula(at: Tensor) -> Tensor:
            nonlocal calls
            calls += 1
            if number == 3 and calls >= call:
                raise KeyboardInterrupt
            return rosenbrock(at)

        return Plain(formula, theta)

    solution = optimiser.run(problem_at, ROSENBROCK.theta, StopRule(5))
    assert solution.interrupted
    assert solution.status == "Interrupted after 2 steps."
    assert torch.equal(solution.theta, finished(optimiser, 2, of=5))


@each_optimiser
@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_a_loss_that_is_not_finite_ends_with_a_sentence(optimiser: Optimiser, bad: float) -> None:
    def problem_at(number: int, theta: Tensor) -> Plain:
        return Plain(lambda t: rosenbrock(t) + (bad if number == 3 else 0.0), theta)

    solution = optimiser.run(problem_at, ROSENBROCK.theta, StopRule(5))
    assert solution.status == "The loss was not finite at step 3."
    assert not solution.interrupted
    assert len(solution.history) == 2
    assert torch.equal(solution.theta, finished(optimiser, 2, of=5))


@each_optimiser
def test_the_least_held_out_value_is_returned(optimiser: Optimiser) -> None:
    """Held-out residuals that want the parameters halfway."""
    half = (ROSENBROCK.theta + ROSENBROCK.best) / 2
    seen: list[tuple[float, Tensor]] = []

    def held_out(theta: Tensor) -> float:
        seen.append((float((theta - half).square().sum()), theta.clone()))
        return seen[-1][0]

    stop = StopRule(steps=60, tolerance=1e-9, held_out_patience=3)
    solution = optimiser.run(ROSENBROCK.at, ROSENBROCK.theta, stop, held_out=held_out)
    assert [record.held_out for record in solution.history] == [value for value, _ in seen[1:]]
    least, theta = min(seen, key=lambda pair: pair[0])
    assert torch.equal(solution.theta, theta)
    if isinstance(optimiser, Adam):
        assert solution.status == "Stopped at the limit of 60 steps."
    else:
        best = [value for value, _ in seen].index(least)
        assert solution.status == f"The held-out residuals stopped falling at step {best}."
        assert len(solution.history) == best + 3


@each_optimiser
def test_time_ends_a_run(optimiser: Optimiser) -> None:
    solution = optimiser.run(ROSENBROCK.at, ROSENBROCK.theta, StopRule(steps=50, seconds=0.0))
    assert len(solution.history) == 1
    assert solution.status.startswith("Stopped after ")
    assert solution.status.endswith(" seconds, 1 steps.")
