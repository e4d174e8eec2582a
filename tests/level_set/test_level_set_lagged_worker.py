"""The lagged worker: one call behind, in parallel, and without hidden failures."""

from __future__ import annotations

import threading

import pytest

from gnrecon.level_set import LaggedWorker


def test_a_call_returns_the_result_of_the_call_before() -> None:
    with LaggedWorker(lambda x: x * x) as square:
        assert [square(n) for n in (2, 3, 4, 5)] == [4, 4, 9, 16]


def test_work_runs_in_parallel_to_the_caller() -> None:
    start = threading.Event()

    def work(number: int) -> int:
        if number:
            assert start.wait(10), "the caller never went on"
        return number

    with LaggedWorker(work) as worker:
        assert worker(0) == 0
        # Returns although the work on 1 has not ended: it waits for the caller.
        assert worker(1) == 0
        start.set()
        assert worker(2) == 1


def test_failures_reach_the_caller() -> None:
    def fail(number: int) -> int:
        raise ValueError(f"no {number}")

    with LaggedWorker(fail) as worker, pytest.raises(ValueError, match="no 7"):
        worker(7)
