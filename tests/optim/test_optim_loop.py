"""Every rule ends a run where it says, with its sentence, and the held-out residuals choose the parameters."""

from __future__ import annotations

import math
import time

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from gnrecon.optim import Record, RunMonitor, StopRule

F64 = torch.float64
Losses = list[tuple[float, float]]


def at(step: int) -> Tensor:
    """Parameters that tell the step that they belong to."""
    return torch.tensor([float(step)], dtype=F64)


def record(step: int, before: float = 2.0, loss: float = 1.0, length: float = 1.0) -> Record:
    return Record(step, before, loss, 0.0, 0.0, length)


def watched(stop: StopRule, losses: Losses, held_out: list[float] | None = None) -> tuple[RunMonitor, str | None]:
    """A monitor after steps of these losses, and what it reason at the last one; it must have reason nothing sooner."""
    value = None if held_out is None else (lambda theta: held_out[int(theta)])
    monitor, reason = RunMonitor(at(0), stop, held_out=value), None
    monitor.start()
    for step, (before, loss) in enumerate(losses, 1):
        assert reason is None, f"it should have gone on at step {step - 1}"
        reason = monitor.update(at(step), record(step, before, loss))
    return monitor, reason


FALLS, IDLE = (2.0, 1.0), (1.0, 0.9999)


def test_a_falling_loss_goes_on() -> None:
    monitor, reason = watched(StopRule(), [FALLS] * 20)
    assert reason is None
    assert [past.step for past in monitor.history] == list(range(1, 21))


def test_idle_steps_in_a_row_converge() -> None:
    assert watched(StopRule(), [IDLE, IDLE, FALLS, IDLE, IDLE, IDLE])[1] == "Converged after 6 steps."


@pytest.mark.parametrize(("loss", "idle"), [(0.89, False), (0.91, True), (1.0, True), (7.0, True)])
def test_the_tolerance_is_relative(loss: float, idle: bool) -> None:
    stop = StopRule(tolerance=0.1, patience=1)
    for scale in (1e-9, 1.0, 1e9):
        reason = watched(stop, [(scale, scale * loss)])[1]
        assert reason == ("Converged after 1 steps." if idle else None)


def test_no_loss_left_is_convergence() -> None:
    monitor = RunMonitor(at(0), StopRule(patience=2))
    assert monitor.update(at(0), record(1, 0.0, 0.0, 0.0)) is None
    assert monitor.update(at(0), record(2, 0.0, 0.0, 0.0)) == "Converged after 2 steps."


@pytest.mark.parametrize("failure", [None, "The matrix was odd."])
def test_no_step_at_all_is_said_and_why(failure: str | None) -> None:
    monitor = RunMonitor(at(0), StopRule(patience=2))
    assert monitor.update(at(0), record(1, 1.0, 1.0, 0.0), "Something else.") is None
    reason = monitor.update(at(0), record(2, 1.0, 1.0, 0.0), failure)
    assert reason == "No step lowered the loss." + (f" {failure}" if failure else "")


def test_a_step_once_taken_makes_it_convergence() -> None:
    monitor = RunMonitor(at(0), StopRule(patience=1))
    monitor.update(at(1), record(1))
    reason = monitor.update(at(1), record(2, 1.0, 1.0, 0.0), "The matrix was odd.")
    assert reason == "Converged after 2 steps. The matrix was odd."


def test_the_limit_of_steps() -> None:
    assert watched(StopRule(steps=4), [FALLS] * 4)[1] == "Stopped at the limit of 4 steps."


def test_the_limit_of_time(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr("gnrecon.optim.loop.perf_counter", lambda: now[0])
    monitor = RunMonitor(at(0), StopRule(seconds=5.0))
    monitor.started = 100.0
    now[0] = 102.5
    assert monitor.update(at(1), record(1)) is None
    now[0] = 105.25
    assert monitor.update(at(2), record(2)) == "Stopped after 5.2 seconds, 2 steps."
    assert [past.seconds for past in monitor.history] == [2.5, 5.25]


def test_seconds_are_those_of_the_run() -> None:
    monitor = RunMonitor(at(0), StopRule())
    time.sleep(0.01)
    monitor.update(at(1), record(1))
    assert 0.01 <= monitor.history[0].seconds < 5.0


def test_held_out_residuals_end_a_run_and_choose_the_parameters() -> None:
    values = [9.0, 5.0, 3.0, 4.0, 3.5, 3.2]
    monitor, reason = watched(StopRule(held_out_patience=3), [FALLS] * 5, values)
    assert reason == "The held-out residuals stopped falling at step 2."
    assert [past.held_out for past in monitor.history] == values[1:]
    assert torch.equal(monitor.solution(reason, "").theta, at(2))


def test_falling_less_than_the_tolerance_counts_as_not_falling() -> None:
    values = [1.0, 0.99, 0.98, 0.97]
    monitor, reason = watched(StopRule(tolerance=0.1, held_out_patience=3), [FALLS] * 3, values)
    assert reason == "The held-out residuals stopped falling at step 3."
    assert torch.equal(monitor.solution(reason, "").theta, at(3)), "the least is returned however little less it is"


def test_a_slow_fall_is_measured_from_the_last_clear_one() -> None:
    """Each step falls by less than the tolerance, but two of them by more."""
    values = [0.94**k for k in range(12)]
    assert watched(StopRule(tolerance=0.1, held_out_patience=3), [FALLS] * 11, values)[1] is None


@pytest.mark.parametrize(
    ("stop", "losses", "sentence"),
    [
        (StopRule(steps=4), [FALLS] * 4, "Stopped at the limit of 4 steps."),
        (StopRule(patience=2), [FALLS, FALLS, IDLE, IDLE], "Converged after 4 steps."),
    ],
)
def test_the_least_is_returned_whatever_ends_the_run(stop: StopRule, losses: Losses, sentence: str) -> None:
    monitor, reason = watched(stop, losses, [9.0, 2.0, 1.0, 4.0, 3.0])
    assert reason == sentence
    assert torch.equal(monitor.solution(reason, "").theta, at(2))


def test_a_start_that_was_the_best_is_returned() -> None:
    monitor, reason = watched(StopRule(held_out_patience=2), [FALLS] * 2, [1.0, 2.0, 3.0])
    assert reason == "The held-out residuals stopped falling at step 0."
    assert torch.equal(monitor.solution(reason, "").theta, at(0))


def test_held_out_values_that_are_no_numbers_never_win() -> None:
    monitor, _ = watched(StopRule(), [FALLS] * 4, [math.nan, 3.0, math.nan, 2.0, math.inf])
    assert torch.equal(monitor.solution("", "").theta, at(3))
    monitor, _ = watched(StopRule(), [FALLS] * 3, [math.nan] * 4)
    assert torch.equal(monitor.solution("", "").theta, at(3)), "without any number the last parameters are returned"


@settings(deadline=None)
@given(
    st.lists(st.floats(0.01, 100.0), min_size=2, max_size=30),
    st.integers(1, 6),
    st.sampled_from([0.0, 1e-3, 0.3]),
)
def test_held_out_rule_against_its_words(values: list[float], patience: int, tolerance: float) -> None:
    """The slow way: find the clear decreases one by one, and the first gap of `patience` steps after one."""
    clear = [0]
    for step, value in enumerate(values):
        if value < (1 - tolerance) * values[clear[-1]]:
            clear.append(step)
    ends = [
        last + patience
        for last, following in zip(clear, [*clear[1:], 10**9], strict=True)
        if following > last + patience
    ]
    last = ends[0] if ends and ends[0] < len(values) else len(values) - 1
    stop = StopRule(tolerance=tolerance, held_out_patience=patience, patience=1000)
    monitor, reason = watched(stop, [FALLS] * last, values)
    least = min(range(last + 1), key=values.__getitem__)
    assert torch.equal(monitor.solution("", "").theta, at(least))
    ended = bool(ends) and ends[0] == last
    assert reason == (f"The held-out residuals stopped falling at step {least}." if ended else None)


def test_an_interrupt_in_the_callback_finds_the_step_noted() -> None:
    def callback(past: Record) -> None:
        assert past.held_out == 1.0
        raise KeyboardInterrupt

    monitor = RunMonitor(at(0), StopRule(), callback, lambda theta: 2.0 - float(theta))
    monitor.start()
    with pytest.raises(KeyboardInterrupt):
        monitor.update(at(1), record(1))
    solution = monitor.solution("Interrupted.", "By hand.", interrupted=True)
    assert len(solution.history) == 1
    assert torch.equal(solution.theta, at(1))
    assert (solution.status, solution.method, solution.interrupted) == ("Interrupted.", "By hand.", True)
