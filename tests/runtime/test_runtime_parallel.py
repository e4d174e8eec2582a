"""Threads: results do not depend on concurrent runs, and the process is left unchanged."""

from __future__ import annotations

import os
import subprocess
import sys
import time
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Barrier, Event, get_ident
from typing import Any

import numpy as np
import pytest
import torch
from made_shapes import box
from scan_files import torus
from threadpoolctl import threadpool_info

from gnrecon.optim import Record
from gnrecon.pipeline import Progress, Reconstruction, reconstruct
from gnrecon.runtime.compute_limits import limited
from gnrecon.runtime.parallel import (
    call_outside,
    end_if_asked,
    fixed_sums,
    in_background,
    map_in_threads,
    run_in_threads,
    set_threads,
    worker_count,
)
from gnrecon.runtime.preload import preload

REPOSITORY = Path(__file__).resolve().parents[2]
FEW: dict[str, Any] = {"widths": (150,), "steps": 2, "resolution": 24}
HEAVY = ("torch", "numpy", "open3d", "scipy", "trimesh", "pymeshlab", "skimage", "rich", "typer", "matplotlib")


class Together(Progress):
    """Makes all threads wait for each other at each stage and step."""

    def __init__(self, barrier: Barrier) -> None:
        self._barrier = barrier

    def stage(self, name: str) -> None:
        del name
        self._barrier.wait(60)

    def step(self, record: Record, total: int) -> None:
        del record, total
        self._barrier.wait(60)


def made(progress: Progress | None) -> list[Callable[[], Reconstruction]]:
    """Two different reconstructions with the same number of stages and steps."""
    ring, brick = torus(600, np.random.default_rng(1)), box(600, np.random.default_rng(2), (2.0, 1.5, 1.0))
    return [
        lambda: reconstruct(*ring, seed=1, progress=progress, **FEW),
        lambda: reconstruct(*brick, seed=2, progress=progress, curvature=True, **FEW),
    ]


def parts(found: Reconstruction) -> list[Any]:
    fit = found.report["fit"]["history"]
    losses = [{name: value for name, value in record.items() if name != "seconds"} for record in fit]
    return [
        found.mesh.vertices.tobytes(),
        found.mesh.faces.tobytes(),
        {name: values.tobytes() for name, values in found.mesh.attributes.items()},
        found.sdf.theta.numpy().tobytes(),
        losses,
        found.report["actions"],
    ]


def test_two_threads_find_what_one_finds() -> None:
    alone = [parts(run()) for run in made(None)]
    with ThreadPoolExecutor(2) as pool:
        beside = list(pool.map(lambda run: parts(run()), made(Together(Barrier(2)))))
    assert beside == alone


def test_the_process_is_left_as_it_was() -> None:
    def state() -> list[Any]:
        return [
            dict(os.environ),
            list(warnings.filters),
            np.geterr(),
            np.random.get_state()[1].tolist(),
            torch.initial_seed(),
            torch.get_rng_state().tolist(),
            torch.get_default_dtype(),
            torch.get_num_threads(),
            torch.is_grad_enabled(),
            torch.are_deterministic_algorithms_enabled(),
            str(Path.cwd()),
        ]

    preload()  # libraries add filters of warnings when they are imported
    before = state()
    reconstruct(*torus(600, np.random.default_rng(1)), threads=1, **FEW)
    assert state() == before


def blas_threads() -> set[int]:
    import scipy.linalg  # noqa: F401 - brings an OpenBLAS of its own

    return {one["num_threads"] for one in threadpool_info() if one["internal_api"] == "openblas"}


def test_a_limit_of_threads_is_that_of_one_run() -> None:
    def counts() -> tuple[int, int, int]:
        with ThreadPoolExecutor(1) as fresh:
            return worker_count(), torch.get_num_threads(), fresh.submit(torch.get_num_threads).result()

    before, of_blas = counts(), blas_threads()
    with limited(before[0] + 2):
        assert counts() == (before[0] + 2, 1, before[2])
        assert blas_threads() == {1}
        with limited(None):
            assert worker_count() == before[0] + 2
        assert blas_threads() == {1}
    assert counts() == before
    assert blas_threads() == of_blas


def test_the_number_of_threads_changes_no_byte() -> None:
    cloud = torus(250, np.random.default_rng(3))
    options: dict[str, Any] = {"quality": "draft", "resolution": 24}
    one, many = (reconstruct(*cloud, threads=threads, **options) for threads in (1, 3))
    assert parts(many) == parts(one)
    assert many.sdf.detail is not None
    assert one.sdf.detail is not None
    assert many.sdf.detail.amplitudes.numpy().tobytes() == one.sdf.detail.amplitudes.numpy().tobytes()
    assert [one.report["resources"]["threads"], many.report["resources"]["threads"]] == [1, 3]


def test_a_thread_that_never_called_torch_keeps_the_number_it_sets() -> None:
    # Torch replaces the number at the first call of a thread.
    def product() -> int:
        set_threads(5)
        torch.ones(3).sum()
        return torch.get_num_threads()

    with limited(3), ThreadPoolExecutor(1) as fresh:
        assert fresh.submit(product).result() == 5


def test_pieces_of_work_keep_their_order_and_have_one_thread_each() -> None:
    def piece(number: int) -> tuple[int, int]:
        time.sleep(0.02 * (number == 0))  # the first is done last
        return number, torch.get_num_threads()

    def default() -> int:
        with ThreadPoolExecutor(1) as fresh:
            return fresh.submit(torch.get_num_threads).result()

    told: list[float] = []
    before = default()
    with limited(3):
        assert map_in_threads(piece, range(5), advance=told.append) == [(number, 1) for number in range(5)]
        assert map_in_threads(piece, []) == []
        assert worker_count() == 3
        assert default() == before
    assert told == [0.2, 0.4, 0.6, 0.8, 1.0]


def test_pieces_have_one_thread_of_openblas_each_outside_of_fixed_sums_too() -> None:
    before, threads = blas_threads(), torch.get_num_threads()
    set_threads(2)
    try:
        assert map_in_threads(lambda _: blas_threads(), range(4)) == [{1}] * 4
    finally:
        set_threads(threads)
    assert blas_threads() == before


@pytest.mark.parametrize("count", [1, 3])
def test_the_first_piece_that_fails_ends_the_work(count: int) -> None:
    begun: list[int] = []

    def piece(number: int) -> None:
        begun.append(number)
        time.sleep(0.005)
        if number == 2:
            raise ValueError("no")

    with limited(count), pytest.raises(ValueError, match="no"):
        map_in_threads(piece, range(200))
    assert len(begun) < 100


def test_brief_pieces_are_done_by_kept_threads_or_by_the_caller() -> None:
    def ident(_: int) -> int:
        time.sleep(0.01)
        return get_ident()

    with limited(2, same_bytes=False):
        assert set(map_in_threads(ident, range(4), brief=True)) == {get_ident()}
    with fixed_sums(2):
        first = set(map_in_threads(ident, range(4), brief=True))
        assert first == set(map_in_threads(ident, range(4), brief=True))
    assert get_ident() not in first
    assert len(first) == 2


def test_importing_gnrecon_imports_no_heavy_library() -> None:
    script = f"import sys, gnrecon\ndir(gnrecon)\nprint([name for name in {HEAVY} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd=REPOSITORY, check=True)
    assert done.stdout == "[]\n"


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_runs_have_their_results_in_order_up_to_the_last(threads: int) -> None:
    seen: list[int] = []

    def run(number: int) -> tuple[int, int, list[int]]:
        inner = map_in_threads(lambda one: one * number, [1, 2])
        call_outside(lambda: seen.append(get_ident()))
        return number, worker_count(), inner

    with fixed_sums(threads):
        found = run_in_threads(run, [1, 2, 3, 4, 5], is_last=lambda result: result[0] == 4)
    assert [(number, inner) for number, _, inner in found] == [(n, [n, 2 * n]) for n in (1, 2, 3, 4)]
    assert {workers for _, workers, _ in found} == {1}, "each run has one thread"
    # Four were wanted; one that has started beside the last has been in vain, and its call may not have been made.
    assert set(seen) == {get_ident()}
    assert 4 <= len(seen) <= (4 if threads == 1 else 5)


def test_a_run_that_is_alone_has_all_threads() -> None:
    with fixed_sums(2):
        assert run_in_threads(lambda _: worker_count(), [0]) == [2]


def test_the_next_run_starts_when_one_ends() -> None:
    third = Event()

    def run(number: int) -> bool:
        if number == 2:
            third.set()
        return number > 0 or third.wait(20)

    with fixed_sums(2):
        assert run_in_threads(run, [0, 1, 2]) == [True] * 3, "the first waits for the third"


def test_runs_after_the_last_are_asked_to_end() -> None:
    both, ended = Barrier(2), []

    def run(number: int) -> int:
        if number < 2:  # the third may have begun, too
            both.wait(20)
        deadline = time.monotonic() + 20
        while number == 1 and time.monotonic() < deadline:
            try:
                end_if_asked()
            except KeyboardInterrupt:
                ended.append(number)
                break
            time.sleep(0.001)
        return number

    with fixed_sums(2):
        assert run_in_threads(run, [0, 1, 2], is_last=lambda _: True) == [0]
    assert ended == [1]


def test_an_interrupt_of_the_caller_ends_the_runs_with_what_they_have() -> None:
    def interrupt() -> None:
        raise KeyboardInterrupt

    def run(number: int) -> str:
        if number == 1:
            call_outside(interrupt)
        try:
            while True:
                end_if_asked()
                time.sleep(0.001)
        except KeyboardInterrupt:
            return f"{number} ended"

    with fixed_sums(2):
        assert run_in_threads(run, [0, 1, 2]) == ["0 ended", "1 ended"]


def test_an_interrupt_that_no_run_has_seen_is_not_lost() -> None:
    def interrupt() -> None:
        raise KeyboardInterrupt

    with fixed_sums(2), pytest.raises(KeyboardInterrupt):
        run_in_threads(lambda _: call_outside(interrupt), [0, 1])


def test_a_run_that_fails_fails_the_call() -> None:
    with fixed_sums(2), pytest.raises(ZeroDivisionError):
        run_in_threads(lambda number: 1 / number, [1, 0])


@pytest.mark.parametrize("threads", [1, 2])
def test_background_work_has_one_torch_thread_and_gives_its_result(threads: int) -> None:
    begun = Event()

    def work() -> tuple[int, int]:
        begun.set()
        return torch.get_num_threads(), get_ident()

    with fixed_sums(threads), in_background(work) as result:
        # With two workers it runs beside the block; with one, not before it is asked for.
        assert begun.wait(10.0 if threads == 2 else 0.0) == (threads == 2)
        of_torch, thread = result()
    assert of_torch == 1
    assert (thread != get_ident()) == (threads == 2)


def test_background_work_ends_with_the_block_and_fails_where_its_result_is_wanted() -> None:
    ended = Event()

    def work() -> None:
        time.sleep(0.1)
        ended.set()
        raise ZeroDivisionError

    with fixed_sums(2), pytest.raises(OSError, match="of the block"), in_background(work):
        raise OSError("of the block")
    assert ended.is_set()
    with fixed_sums(2), in_background(work) as result, pytest.raises(ZeroDivisionError):
        result()
