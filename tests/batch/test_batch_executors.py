"""How jobs are run: as many at a time as a machine takes, and on a Dask cluster that may lose a worker."""

from __future__ import annotations

import os
import re
import signal
import time
from functools import partial
from pathlib import Path

import fake_work
import psutil
import pytest
from fake_work import job, notes

from gnrecon.batch import executors
from gnrecon.batch.executors import FileRemoved, fitting_jobs, run_on_cluster
from gnrecon.batch.job import Job, JobOutcome, Limits, Status, running_folder
from gnrecon.options import Options
from gnrecon.runtime.dask_scheduler import dask_client
from gnrecon.runtime.errors import UsageError

# Dask closes its threads and sockets late.
pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")


def test_nothing_is_lost_and_nothing_done_twice_where_a_worker_is_killed(tmp_path: Path) -> None:
    jobs = [job(tmp_path, f"s{number}", "good 0.4") for number in range(6)]
    jobs += [job(tmp_path, "bad", "exit 4"), job(tmp_path, "killed", "signal SIGSEGV")]
    outcomes: list[JobOutcome] = []

    def done(outcome: JobOutcome) -> None:
        outcomes.append(outcome)
        if len(outcomes) == 2:
            kill_a_worker(tmp_path)

    run_on_cluster(jobs, None, 2, [], done, work=fake_work.WORK)
    causes = {outcome.name: outcome.cause for outcome in outcomes}
    assert len(causes) == len(outcomes) == len(jobs)
    assert {name: str(cause) for name, cause in causes.items() if cause is not None} == {
        "bad": "fit",
        "killed": "signal",
    }
    ended = notes(tmp_path / "scans", "ended")
    assert set(ended) == {f"s{number}" for number in range(6)}
    # What was finished when the worker was killed is not done twice; the scan that it had is begun again.
    assert all(ended.count(outcome.name) == 1 for outcome in outcomes[:2] if not outcome.failed)
    assert len(notes(tmp_path / "scans", "began")) > len(jobs)
    assert not list(running_folder(tmp_path / "meshes").glob(".batch-*"))
    # What is there is not done again, whichever the engine.
    again: list[JobOutcome] = []
    run_on_cluster(jobs[:6], None, 1, [], again.append, work=fake_work.WORK)
    assert {outcome.status for outcome in again} == {Status.UNCHANGED}


def kill_a_worker(folder: Path) -> None:
    """Kill the worker that forked the child of a running scan."""
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        for process in psutil.Process().children(recursive=True):
            try:
                server = process.parent()
                if _is_child(process, folder) and server is not None and (worker := server.parent()) is not None:
                    os.kill(worker.pid, signal.SIGKILL)
                    return
            except psutil.Error:
                continue
    raise AssertionError("no scan is running")


def _is_child(process: psutil.Process, folder: Path) -> bool:
    return any(Path(file.path).is_relative_to(folder / "meshes" / ".gnrecon" / "logs") for file in process.open_files())


def test_a_scheduler_that_does_not_answer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gnrecon.batch.executors.dask_client", partial(dask_client, timeout="1s"))
    outcomes: list[JobOutcome] = []
    for address in ("tcp://127.0.0.1:9", "nonsense://x"):
        with pytest.raises(UsageError, match=f"No scheduler answers at {re.escape(address)}"):
            run_on_cluster([job(tmp_path, "a", "good")], address, 1, [], outcomes.append)
    assert not outcomes


def test_a_file_that_appears_late_does_not_stop_a_job(tmp_path: Path) -> None:
    stop = FileRemoved(tmp_path / "alive")
    assert not stop.is_set()
    (tmp_path / "alive").touch()
    assert not stop.is_set()
    (tmp_path / "alive").unlink()
    assert stop.is_set()


def a_job(folder: Path, limit: float | None = None, **options: object) -> Job:
    values = Options.of(**{"threads": 1, **options}).as_dict()
    return fake_work.job(folder, "scan", "good", Limits(memory_mb=limit), options=values)


def test_as_many_jobs_as_cores_and_memory_allow(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(executors, "available_cores", lambda: 8)
    monkeypatch.setattr(executors, "available_memory_mb", lambda: 100_000.0)
    assert fitting_jobs([a_job(tmp_path)] * 20, threads=1) == 8
    assert fitting_jobs([a_job(tmp_path)] * 20, threads=3) == 2
    assert fitting_jobs([a_job(tmp_path)] * 20, threads=16) == 1
    assert fitting_jobs([a_job(tmp_path)] * 3, threads=1) == 3
    assert fitting_jobs([a_job(tmp_path, limit=30_000.0)] * 20, threads=1) == 3
    assert fitting_jobs([a_job(tmp_path), a_job(tmp_path, resolution=1480)] * 20, threads=1) == 6
    monkeypatch.setattr(executors, "available_memory_mb", lambda: 100.0)
    assert fitting_jobs([a_job(tmp_path)] * 20, threads=1) == 1


def test_what_this_machine_has_is_positive() -> None:
    assert executors.available_cores() >= 1
