"""Local fields by blocks: the same for any blocks and processes, without seams, resumable, and within memory."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import psutil
import pytest
import threadpoolctl
import torch

from gnrecon.field.networks import Siren
from gnrecon.field.partition_of_unity import Detail
from gnrecon.fit import FitOptions, NeuralSDF
from gnrecon.fit.blocks import block, workers
from gnrecon.fit.blocks import solve as large
from gnrecon.fit.blocks.store import WorkFolder
from gnrecon.fit.fit_options import QUALITIES
from gnrecon.fit.global_field import FieldResiduals
from gnrecon.fit.local_fields import fit_detail
from gnrecon.fit.model_selection import Hyperparameters
from gnrecon.fit.parameters import LocalFieldParameters
from gnrecon.geometry.arrays import Int
from gnrecon.geometry.point_cloud import Frame, Samples
from gnrecon.geometry.signed_distance import Box
from gnrecon.options import Options
from gnrecon.runtime.dask_scheduler import dask_client
from gnrecon.runtime.errors import Cancelled, FitError, MemoryLimitError, UsageError
from gnrecon.runtime.progress import ProgressCallback, ignore_progress

COUNT = 1500
AXES = np.array([1.0, 0.6, 0.5])
BELIEF = Hyperparameters(0.07, 1e-3, 0.05)
FEATURES = 60


def fixed_belief(*_: object) -> Hyperparameters:
    """Replace the choice, which is tested elsewhere."""
    return BELIEF


def ellipsoid() -> Samples:
    rng = np.random.default_rng(0)
    u = rng.standard_normal((COUNT, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    normals = u / AXES
    frame = Frame(np.array([10.0, 20.0, 30.0]), 2.0)
    return Samples(u * AXES, normals / np.linalg.norm(normals, axis=1, keepdims=True), frame)


def constant_field(samples: Samples) -> NeuralSDF:
    """A global field that is constant."""
    field = Siren((8,))
    theta = torch.zeros(field.layout.count, dtype=torch.float64)
    theta[-1] = 0.05
    return NeuralSDF(field, theta, samples.frame, Box.around(samples.points, 0.1))


def fitted(
    folder: Path | None = None,
    block_points: int = 200,
    scheduler: str | None = None,
    advance: ProgressCallback = ignore_progress,
    samples: Samples | None = None,
    with_workers: workers.Workers | None = None,
) -> tuple[NeuralSDF, Detail]:
    samples = samples or ellipsoid()
    sdf, rng = constant_field(samples), np.random.default_rng(0)
    held = np.arange(COUNT) % 6 == 0
    data = sdf, samples, held, FitOptions(quality="draft"), rng
    return sdf, large.fit_large(*data, folder, advance, scheduler, with_workers, block_points)


@pytest.fixture(autouse=True)
def _known_belief(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fix length and noise; their choice is tested elsewhere."""
    monkeypatch.setattr(large, "select_hyperparameters", fixed_belief)
    monkeypatch.setitem(QUALITIES, "draft", FEATURES)


@pytest.fixture(scope="module")
def whole() -> Detail:
    """The detail of an undisturbed fit in one process."""
    with pytest.MonkeyPatch.context() as patch, threads(1):
        patch.setattr(large, "select_hyperparameters", fixed_belief)
        patch.setitem(QUALITIES, "draft", FEATURES)
        return fitted(block_points=200)[1]


@contextmanager
def threads(count: int) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def same(one: Detail, other: Detail) -> bool:
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in ("keys", "lengths", "amplitudes"))


def test_neither_blocks_nor_processes_change_a_digit(whole: Detail, tmp_path: Path) -> None:
    with workers.started_workers(3) as several:
        _, parts = fitted(tmp_path, block_points=150, with_workers=several)
    blocks = len(WorkFolder(tmp_path).array("ends")) - 1
    assert blocks > 8
    assert same(whole, parts)


# Dask closes its threads and sockets late.
@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_cluster_that_loses_a_worker_changes_no_digit(whole: Detail, tmp_path: Path) -> None:
    from distributed import LocalCluster

    killed, folder, options = [], tmp_path / "work", {"dashboard_address": None, "silence_logs": 50}
    with LocalCluster(n_workers=2, threads_per_worker=1, processes=True, **options) as cluster:

        def kill(share: float) -> None:
            if not killed and share > LocalFieldParameters.selection_time_share:
                killed.append(cluster.workers[0].pid)
                os.kill(killed[0], signal.SIGKILL)

        _, parts = fitted(folder, 150, cluster.scheduler_address, kill)
        assert killed
        assert same(whole, parts)
        # Saved blocks are not solved again, and a block that cannot be solved is an error.
        (folder / "block-000001.npz").unlink()
        assert same(whole, fitted(folder, 150, cluster.scheduler_address)[1])
        # Where nothing is left to do, no scheduler is needed.
        assert same(whole, fitted(folder, 150, "tcp://127.0.0.1:9")[1])
        (folder / "block-000000.npz").unlink()
        (folder / "normals.npy").unlink()
        with pytest.raises(FitError, match=r"The cluster could not solve a block: .*normals\.npy"):
            workers.solve_on_cluster(WorkFolder(folder), [0], cluster.scheduler_address, ignore_progress, retries=0)


def test_a_scheduler_needs_a_shared_folder_and_an_answer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UsageError, match="needs a work folder"):
        Options(block_scheduler="tcp://127.0.0.1:9")
    assert Options(block_scheduler="tcp://127.0.0.1:9", work_dir="work").block_scheduler == "tcp://127.0.0.1:9"
    monkeypatch.setattr(workers, "dask_client", partial(dask_client, timeout="1s"))
    with pytest.raises(UsageError, match=r"No scheduler answers at tcp://127\.0\.0\.1:9"):
        workers.solve_on_cluster(WorkFolder(tmp_path), [0], "tcp://127.0.0.1:9", ignore_progress)


def test_it_is_the_smaller_scans_fit(whole: Detail) -> None:
    detail, samples = whole, ellipsoid()
    sdf = constant_field(samples)
    residuals = FieldResiduals.of(sdf, samples)
    single = fit_detail(sdf, residuals, fixed_belief(), FEATURES, np.random.default_rng(0), "cpu")
    assert np.array_equal(single.keys, detail.keys)
    assert single.lengths == pytest.approx(detail.lengths, rel=1e-12)
    by_single, by_blocks = (0.05 + d.value(samples.points) for d in (single, detail))
    # Only the samples of free space differ, so that both are as near to the points.
    assert np.abs(by_blocks).mean() < 1.2 * np.abs(by_single).mean() < 4e-3
    off = samples.points + 0.05 * samples.normals * np.where(np.arange(COUNT) % 2, -1.0, 1.0)[:, None]
    assert ((0.05 + detail.value(off) > 0) == (np.arange(COUNT) % 2 == 0)).mean() > 0.97


def test_blocks_know_how_sure_normals_are(tmp_path: Path) -> None:
    samples, rng = ellipsoid(), np.random.default_rng(4)
    deviations = np.where(rng.random(COUNT) < 0.3, 1.0, 0.02)
    tilted = samples.normals + deviations[:, None] * rng.standard_normal((COUNT, 3))
    tilted /= np.linalg.norm(tilted, axis=1, keepdims=True)
    off = []
    for known, name in ((None, "unknown"), (deviations, "known")):
        detail = fitted(tmp_path / name, samples=replace(samples, normals=tilted, deviations=known))[1]
        off.append(np.abs(detail.value_and_gradient(samples.points)[1] - samples.normals).mean())
    assert off[1] < 0.7 * off[0]


def test_there_is_no_seam(whole: Detail) -> None:
    detail = whole
    partition, rng = detail.partition, np.random.default_rng(1)
    u = (ellipsoid().points - partition.origin) / partition.cell
    rows, axis = np.arange(COUNT), rng.integers(3, size=COUNT)
    # Onto the nearest face of a cell, or to where a neighbour's weight begins or ends.
    u[rows, axis] = np.floor(u[rows, axis]) + rng.choice(
        [0.0, partition.overlap / 2, 1.0 - partition.overlap / 2], COUNT
    )
    step = 1e-7 * np.eye(3)[axis]
    x = partition.origin + partition.cell * u
    (low, low_slope), (high, high_slope) = (detail.value_and_gradient(x + side) for side in (-step, step))
    assert np.abs(detail.value(x)).max() > 0.01
    assert np.abs(high - low).max() < 1e-5
    assert np.abs(high_slope - low_slope).max() < 1e-4


def test_what_was_solved_is_not_solved_again(whole: Detail, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def cancel(share: float) -> None:
        if share > 0.5:
            raise Cancelled

    samples = ellipsoid()
    with pytest.raises(Cancelled), threads(1):
        large.fit_large(
            constant_field(samples),
            samples,
            np.arange(COUNT) % 6 == 0,
            FitOptions(quality="draft"),
            np.random.default_rng(0),
            tmp_path,
            cancel,
            block_points=200,
        )
    finished = {path.name: path.stat().st_mtime_ns for path in tmp_path.glob("block-*.npz")}
    solved: list[int] = []
    solve = block.BlockSolver.solve
    monkeypatch.setattr(block.BlockSolver, "solve", lambda self, number: solved.append(number) or solve(self, number))
    with threads(1):
        _, taken_up = fitted(tmp_path)
    count = len(WorkFolder(tmp_path).array("ends")) - 1
    assert 0 < len(finished) < count
    assert len(solved) == count - len(finished)
    assert {name: (tmp_path / name).stat().st_mtime_ns for name in finished} == finished
    assert same(whole, taken_up)


def test_a_killed_process_leaves_whole_blocks(whole: Detail, tmp_path: Path) -> None:
    program = (
        f"import sys; sys.path[:0] = {[str(Path(__file__).parent), *sys.path]!r}\n"
        "import time, torch; from pathlib import Path\n"
        "from gnrecon.fit.blocks import solve as large; import test_fit_blocks as own\n"
        "torch.set_num_threads(1); large.select_hyperparameters = own.fixed_belief\n"
        "own.QUALITIES['draft'] = own.FEATURES\n"
        "save = own.WorkFolder.save\n"
        "own.WorkFolder.save = lambda *arguments: (save(*arguments), time.sleep(0.2))\n"
        f"own.fitted(Path({str(tmp_path)!r}))\n"
    )
    process = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.DEVNULL)
    try:
        while not list(tmp_path.glob("block-*.npz")) and process.poll() is None:
            time.sleep(0.02)
    finally:
        os.kill(process.pid, signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    finished = {path.name: path.read_bytes() for path in tmp_path.glob("block-*.npz")}
    _, taken_up = fitted(tmp_path)
    assert finished
    assert {name: (tmp_path / name).read_bytes() for name in finished} == finished
    assert same(whole, taken_up)


def test_memory_holds_one_group_and_its_neighbours(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    held: list[int] = []
    around = block.BlockSolver._nearby_points

    def counted(self: block.BlockSolver, keys: Int) -> Int:
        rows = around(self, keys)
        held.append(len(rows))
        return rows

    monkeypatch.setattr(block.BlockSolver, "_nearby_points", counted)
    monkeypatch.setattr(large, "select_hyperparameters", lambda *_: Hyperparameters(0.032, 1e-3, 0.05))
    with threads(1):
        _, detail = fitted(tmp_path)
    assert isinstance(WorkFolder(tmp_path).array("points").base, np.memmap)
    assert max(held) < COUNT / 6
    assert len(detail) > len(held) > 30


def test_cubes_see_all_of_their_points(tmp_path: Path) -> None:
    fitted(tmp_path)
    found = block.BlockSolver.of(WorkFolder(tmp_path), "cpu")
    points, partition = found.residuals.points, found.partition
    reach = partition.reach + 2 * found.radius
    for key in found.keys[::7]:
        inside = np.flatnonzero((np.abs(points - partition.center(key)) <= reach).all(axis=1))
        assert set(inside) <= set(found._nearby_points(key[None]))


def test_another_runs_folder_is_refused(tmp_path: Path) -> None:
    fitted(tmp_path)
    with pytest.raises(UsageError, match="belongs to another run"):
        fitted(tmp_path, block_points=300)


@pytest.mark.parametrize(
    ("words", "error", "sentence"),
    [
        ("exit 3", FitError, "ended with status 3"),
        ("kill -9 $$", MemoryLimitError, "killed by signal 9"),
        ("echo InputError: lost > /proc/self/fd/${3#*,}", FitError, "could not be solved: InputError: lost"),
    ],
)
def test_a_process_that_fails_ends_the_fit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: str, error: type[Exception], sentence: str
) -> None:
    program = tmp_path / "python"
    program.write_text(f"#!/bin/sh\n{words}\n")
    program.chmod(0o755)
    monkeypatch.setattr(workers.sys, "executable", str(program))
    with workers.started_workers(2) as started, pytest.raises(error, match=sentence):
        workers.solve_blocks(WorkFolder(tmp_path), [0, 1, 2], started, "cpu", ignore_progress)


def test_a_forked_process_that_dies_ends_the_fit(tmp_path: Path) -> None:
    with workers.started_workers(3) as started:
        children = forked(started)
        assert len(children) == 2
        children[1].kill()
        assert started.first.wait(20) == -signal.SIGKILL
        with pytest.raises(MemoryLimitError, match="killed by signal 9"):
            workers.solve_blocks(WorkFolder(tmp_path), [0, 1, 2], started, "cpu", ignore_progress)
        assert not psutil.pid_exists(children[0].pid)


def test_forked_processes_answer_errors_and_end_with_the_first_one(tmp_path: Path) -> None:
    with workers.started_workers(2) as started:
        children = forked(started)
        for requests, answers in started.pipes:
            requests.write(json.dumps([str(tmp_path), 0]).encode() + b"\n")
            assert answers.readline().startswith("InputError: ")
    assert started.first.poll() is not None
    assert not psutil.pid_exists(children[0].pid)


def forked(started: workers.Workers) -> list[psutil.Process]:
    """The processes that the first one has forked, once they are there."""
    first = psutil.Process(started.first.pid)
    while len(children := first.children()) < len(started.pipes) - 1:
        assert started.first.poll() is None
        time.sleep(0.02)
    return children


@pytest.mark.parametrize(
    ("count", "free", "device", "expected"),
    [(2, 9, "cpu", 2), (3, 2, "cpu", 2), (1, 9, "cpu", 0), (4, 1, "cpu", 0), (4, 9, "cuda", 0)],
)
def test_there_are_as_many_workers_as_threads(
    count: int, free: int, device: str, expected: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(workers, "_affordable_processes", lambda: free)
    with threads(count), workers.workers_for(device) as started:
        assert (0 if started is None else len(started.pipes)) == expected


def test_a_worker_computes_with_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    """With more, those of several workers would wait for each other, several times as long as they work."""
    found: list[int] = []

    def count(*_: object) -> None:
        pools = threadpoolctl.threadpool_info()
        found.extend(
            [torch.get_num_threads(), *(one["num_threads"] for one in pools if one["internal_api"] == "openblas")]
        )

    monkeypatch.setattr(workers, "solve_block", count)
    with threadpoolctl.threadpool_limits(2):
        workers.solve_on_worker("folder", 0)
    assert len(found) > 1
    assert set(found) == {1}
