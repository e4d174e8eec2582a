"""Runs one job: skips it when nothing has changed, else runs and retries it in a child process and records the result.

Each attempt writes into a folder of its own within the output folder. Only after its process has succeeded are the
files hashed and recorded, and then moved to their final names, so that a killed attempt leaves no partial output.
"""

from __future__ import annotations

import json
import os
import shlex
import shutil
import signal
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import psutil

from gnrecon.batch.child_process import ForkedChild, ForkServerError, start_child
from gnrecon.batch.job import (
    Cause,
    Job,
    JobOutcome,
    JobRecord,
    Limits,
    Status,
    Stop,
    cause_of,
    describe_signal,
    failure_file,
    figures_of,
    file_hash,
    hash_if_exists,
    identity_of,
    read_record,
    running_folder,
)
from gnrecon.runtime.errors import ExitCode, GnreconError, OutputError, failure
from gnrecon.runtime.files import sync
from gnrecon.runtime.memory_budget import is_capped, kills_for_memory


def run_job(
    job: Job, stop: Stop | None = None, environment: Mapping[str, str] | None = None, work: str | None = None
) -> JobOutcome:
    """Run one job in a child process, unless its result exists already; failures are reported by the outcome.

    Parameters
    ----------
    job : Job
    stop : set by the caller when the job should end now
    environment : variables to set in the child
    work : module with ``work(argument) -> exit code``, by default `gnrecon.batch.child_main`
    """
    try:
        return _run(job, _Launch(stop or threading.Event(), dict(environment or {}), work))
    except GnreconError as error:
        return _failed(job, cause_of(error.exit_code), str(error), error.exit_code)
    except OSError as error:
        sentence = f"{error.filename or job.output}: {error.strerror or error}."
        return _failed(job, Cause.OUTPUT, sentence, ExitCode.OUTPUT)
    except Exception as error:
        # Whatever happens to one scan costs that scan, and not the batch.
        sentence, code = failure(error)
        return _failed(job, cause_of(code), sentence, code)


@dataclass(frozen=True)
class _Launch:
    """How the attempts of a job are started, and what stops them."""

    stop: Stop
    environment: dict[str, str]
    work: str | None


def _run(job: Job, launch: _Launch) -> JobOutcome:
    try:
        identity = identity_of(job)
    except OSError as error:
        sentence = f"{error.filename}: it cannot be read ({error.strerror})."
        return _failed(job, Cause.INPUT, sentence, ExitCode.INPUT)
    record = read_record(job.record())
    if record is not None and not job.fresh and record.is_current(identity, job.output):
        return _succeeded(job, Status.UNCHANGED, record.facts)
    _require_own_outputs(job, record)
    attempts, seconds = 0, 0.0
    while True:
        outcome = _attempt(job, identity, launch)
        attempts, seconds = attempts + 1, seconds + outcome.seconds
        transient = outcome.cause is not None and outcome.cause.is_transient
        if not transient or launch.stop.is_set() or attempts > job.retry:
            return replace(outcome, attempts=attempts, seconds=round(seconds, 2))


def _require_own_outputs(job: Job, record: JobRecord | None) -> None:
    """Refuse to replace files that this batch has not written."""
    if job.overwrite:
        return
    for name in job.file_names().values():
        existing = hash_if_exists(job.output / name)
        if existing is not None and (record is None or not record.knows(name, existing)):
            raise OutputError(
                f"{job.output / name} exists already and was not written by this batch, or was changed since; "
                "choose another folder or add --overwrite."
            )


def _attempt(job: Job, identity: dict[str, Any], launch: _Launch) -> JobOutcome:
    job.log().parent.mkdir(parents=True, exist_ok=True)
    with _attempt_folder(job) as folder:
        if "config" in job.kinds:
            (folder / "files" / job.file_names()["config"]).write_text(job.config, encoding="utf-8")
        # Libraries write temporary files to TMPDIR, within the folder, so that they are deleted even after a crash.
        end = run_child(
            _argument(job, folder),
            threads=job.options["threads"],
            log=job.log(),
            environment={"TMPDIR": str((folder / "temporary").absolute()), **launch.environment},
            limits=job.limits,
            stop=launch.stop,
            work=launch.work,
        )
        if end.cause is not None:
            return _failed(job, end.cause, _failure_sentence(end, folder), end.exit_code, end)
        return replace(_publish(job, folder, identity, end), seconds=end.seconds)


@contextmanager
def _attempt_folder(job: Job) -> Iterator[Path]:
    """A temporary folder with the subfolders that the files' names need; it is removed afterwards."""
    running = running_folder(job.output)
    running.mkdir(parents=True, exist_ok=True)
    folder = Path(tempfile.mkdtemp(prefix=f"{Path(job.name).name}-", dir=running))
    try:
        (folder / "temporary").mkdir()
        (folder / "files" / job.name).parent.mkdir(parents=True)
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _argument(job: Job, folder: Path) -> dict[str, Any]:
    """The child's task, as plain values."""
    files = {kind: f"files/{name}" for kind, name in job.file_names().items()}
    return {
        "name": job.name,
        "folder": str(folder.absolute()),
        "scan": str(job.scan),
        "files": {"report": "report.json", **files, "thumbnail": "thumbnail.png"},
        "options": dict(job.options),
        "reference": None if job.reference is None else str(job.reference),
        "command": _command(job),
    }


def _command(job: Job) -> str:
    """A command line that makes the same mesh again."""
    paths = {kind: str(job.output / name) for kind, name in job.file_names().items()}
    config = ["--config", paths["config"]] if "config" in paths else []
    return shlex.join(["gnrecon", str(job.scan), "-o", paths["mesh"], *config])


def _failure_sentence(end: ChildEnd, folder: Path) -> str:
    if end.message:
        return end.message
    try:
        return failure_file(folder).read_text(encoding="utf-8")
    except OSError:
        return f"Its process ended with exit code {end.exit_code}."


def _publish(job: Job, folder: Path, identity: dict[str, Any], end: ChildEnd) -> JobOutcome:
    """Record a result, then move its files to their final names."""
    names = job.file_names()
    files = _argument(job, folder)["files"]
    report = json.loads((folder / files["report"]).read_text(encoding="utf-8"))
    facts = {"figures": figures_of(report), "metrics": report["metrics"], "peak_memory_mb": end.peak_memory_mb}
    job.thumbnail().parent.mkdir(parents=True, exist_ok=True)
    (folder / files["thumbnail"]).replace(job.thumbnail())
    # The hashes of replaced files let a batch that is killed before the renaming know them as its own.
    existing = {name: hash_if_exists(job.output / name) for name in names.values()}
    record = JobRecord(
        identity,
        {name: file_hash(folder / "files" / name) for name in names.values()},
        {name: known for name, known in existing.items() if known is not None},
        (folder / "files").relative_to(job.output).as_posix(),
        facts,
    )
    record.write(job.record())
    record.move_into_place(job.output)
    # Makes the new names durable, so that a power failure does not undo them.
    sync(job.output)
    return _succeeded(job, Status.MADE, facts)


def _succeeded(job: Job, status: Status, facts: Mapping[str, Any]) -> JobOutcome:
    """The outcome of a result that exists, with the facts of its record."""
    files = {kind: str(job.output / name) for kind, name in job.file_names().items()}
    return JobOutcome(
        job.name,
        str(job.scan),
        status,
        files=files,
        thumbnail=str(job.thumbnail()),
        log=str(job.log()),
        **facts,
    )


def _failed(
    job: Job, cause: Cause | None, message: str, exit_code: int | None, end: ChildEnd | None = None
) -> JobOutcome:
    log = str(job.log()) if job.log().is_file() else ""
    return JobOutcome(
        job.name,
        str(job.scan),
        Status.FAILED,
        cause,
        message,
        exit_code,
        log=log,
        seconds=0.0 if end is None else end.seconds,
        peak_memory_mb=None if end is None else end.peak_memory_mb,
    )


# Memory is watched from outside, as the resident memory of the child and its descendants. A limit of the address space
# (``RLIMIT_AS``) would also count what torch and CUDA merely reserve.


@dataclass(frozen=True)
class ChildEnd:
    """How a child process ended.

    Parameters
    ----------
    cause : why it failed; None where it succeeded
    exit_code : of the child; None where it was killed for taking too long
    message : a sentence, where the child itself could not write one
    peak_memory_mb : greatest resident memory that was seen, in MB of 10^6 bytes
    seconds : from the child's start to its end
    """

    cause: Cause | None
    exit_code: int | None
    message: str
    peak_memory_mb: float
    seconds: float


def run_child(
    argument: Mapping[str, Any],
    *,
    threads: int,
    log: Path,
    environment: Mapping[str, str],
    limits: Limits,
    stop: Stop | None = None,
    work: str | None = None,
) -> ChildEnd:
    """Run work in a child process, within limits of time and memory, and wait for its end.

    Where the fork server was killed from outside, it is started again, and so is the work, unless it should end.

    Parameters
    ----------
    argument : of the work, plain values
    threads : of the numerical libraries
    log : file for the child's output
    environment : variables to set in the child
    limits : Limits
    stop : set by the caller when the child should end now
    work : module with ``work(argument) -> exit code``

    Raises
    ------
    ForkServerError
        When no child can be started, the fork server has ended twice, or it has ended and so should the work.
    """
    stop = stop or threading.Event()
    run = partial(_run_child_once, argument, threads, log, environment, limits, stop, work)
    try:
        return run()
    except ForkServerError:
        if stop.is_set():
            raise
        return run()


def _run_child_once(
    argument: Mapping[str, Any],
    threads: int,
    log: Path,
    environment: Mapping[str, str],
    limits: Limits,
    stop: Stop,
    work: str | None,
    *,
    poll_seconds: float = 0.1,
) -> ChildEnd:
    """Run work in one child; limits are checked every `poll_seconds`, often enough for memory that grows quickly."""
    kills = kills_for_memory()
    with start_child(threads, argument, log, environment, work) as child:
        start, peak, monitor = time.monotonic(), 0.0, MemoryMonitor(child.pid)
        while (status := child.wait(poll_seconds)) is None:
            memory, seconds = monitor.memory_mb(), round(time.monotonic() - start, 3)
            peak = max(peak, round(memory, 1))
            if stop.is_set():
                return _killed(child, ChildEnd(Cause.INTERRUPTED, ExitCode.INTERRUPTED, "Interrupted.", peak, seconds))
            if limits.memory_mb is not None and memory > limits.memory_mb:
                sentence = f"It needed {memory:,.0f} MB of memory; the limit is {limits.memory_mb:,.0f} MB (--memory)."
                return _killed(child, ChildEnd(Cause.MEMORY, ExitCode.MEMORY, sentence, peak, seconds))
            if limits.seconds is not None and seconds > limits.seconds:
                sentence = f"It had not ended after {limits.seconds:g} s, which is the limit (--timeout)."
                return _killed(child, ChildEnd(Cause.TIMEOUT, None, sentence, peak, seconds))
        seconds = round(time.monotonic() - start, 3)
    message = describe_signal(-status) if status < 0 else ""
    if _died_for_memory(status, log, kills):
        sentence = f"Its memory ran out in native code, which ended it by {_end(status)}."
        return ChildEnd(Cause.MEMORY, ExitCode.MEMORY, sentence, peak, seconds)
    return ChildEnd(cause_of(status), status, message, peak, seconds)


def _died_for_memory(status: int, log: Path, kills: int, *, last_bytes: int = 20_000) -> bool:
    """Whether a child ended, outside of Python, because it got no memory.

    Parameters
    ----------
    status : its exit code, or negative signal
    log : its output, in which native code says so
    kills : `kills_for_memory` before its start
    """
    if status == -signal.SIGKILL:
        return kills_for_memory() > kills
    if status not in (-signal.SIGABRT, -signal.SIGSEGV, -signal.SIGBUS, ExitCode.UNFORESEEN):
        return False
    with suppress(OSError), log.open("rb") as file:
        file.seek(max(0, file.seek(0, os.SEEK_END) - last_bytes))
        last = file.read()
        # C++, OpenMP and OpenBLAS; what Python has seen has an exit code and a sentence.
        words = (b"bad_alloc", b"annot allocate memory", b"ut of memory", b"Memory allocation", b"malloc failed")
        return (is_capped() and status < 0) or (b"\ngnrecon: " not in last and any(word in last for word in words))
    return False


def _end(status: int) -> str:
    return signal.Signals(-status).name if status < 0 else f"exit code {status}"


def _killed(child: ForkedChild, end: ChildEnd, *, wait_seconds: float = 5.0) -> ChildEnd:
    """Kill a child with its descendants, and wait at most `wait_seconds` until it is gone."""
    for process in _process_tree(child.pid):
        with suppress(psutil.Error):
            process.kill()
    with suppress(ForkServerError):
        child.wait(wait_seconds)
    return end


class MemoryMonitor:
    """Measures the memory of a process and its descendants repeatedly.

    Parameters
    ----------
    pid : of the process
    search_interval : measurements between two searches for descendants, which look at every process of the machine
    """

    def __init__(self, pid: int, *, search_interval: int = 10) -> None:
        self._pid, self._search_interval, self._count = pid, search_interval, 0
        self._tree: list[psutil.Process] = []

    def memory_mb(self) -> float:
        """Return the resident memory, in MB of 10^6 bytes; 0 when the process has ended."""
        if self._count % self._search_interval == 0:
            self._tree = _process_tree(self._pid)
        self._count += 1
        total = 0
        for process in self._tree:
            with suppress(psutil.Error):
                total += process.memory_info().rss
        return total / 1e6


def _process_tree(pid: int) -> list[psutil.Process]:
    try:
        process = psutil.Process(pid)
        return [process, *process.children(recursive=True)]
    except psutil.Error:
        return []
