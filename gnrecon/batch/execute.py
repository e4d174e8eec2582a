"""One job from its beginning to its end: skipped when nothing has changed, tried, tried again, and recorded.

An attempt writes into a folder of its own below the output folder. Only when its process has ended well are the files
hashed and recorded, and then receive their names, so that whatever kills an attempt leaves nothing half written.
"""

from __future__ import annotations

import json
import shlex
import shutil
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

from gnrecon.batch.child_process import WORK, Child, ForkerError, start_child
from gnrecon.batch.job import (
    FAILURE,
    PASSING,
    Cause,
    Job,
    Limits,
    Outcome,
    Record,
    Status,
    Stop,
    cause_of,
    describe_signal,
    figures_of,
    file_hash,
    hash_if_there,
    identity_of,
    read_record,
    running_folder,
)
from gnrecon.runtime.errors import ExitCode, GnreconError, OutputError
from gnrecon.runtime.files import sync

REPORT, THUMBNAIL = "report.json", "thumbnail.png"


def run_job(
    job: Job, stop: Stop | None = None, environment: Mapping[str, str] | None = None, work: str = WORK
) -> Outcome:
    """Do one job, in a child process, unless its result is there already; whatever happens is told by the outcome.

    Parameters
    ----------
    job : Job
    stop : set by the caller when the job is to end now
    environment : variables that the child is to have
    work : module with ``work(argument) -> exit code``, see `gnrecon.batch.child`
    """
    try:
        return _run(job, _Means(stop or threading.Event(), dict(environment or {}), work))
    except GnreconError as error:
        return _failed(job, cause_of(error.exit_code), str(error), error.exit_code)
    except OSError as error:
        said = f"{error.filename or job.output}: {error.strerror or error}."
        return _failed(job, Cause.OUTPUT, said, ExitCode.OUTPUT)


@dataclass(frozen=True)
class _Means:
    """How attempts are made, and when they are to end."""

    stop: Stop
    environment: dict[str, str]
    work: str


def _run(job: Job, means: _Means) -> Outcome:
    try:
        identity = identity_of(job)
    except OSError as error:
        said = f"{error.filename}: it cannot be read ({error.strerror})."
        return _failed(job, Cause.INPUT, said, ExitCode.INPUT)
    record = read_record(job.record())
    if record is not None and not job.fresh and record.holds(identity, job.output):
        return _told(job, Status.UNCHANGED, record.told)
    _require_own(job, record)
    attempts, seconds = 0, 0.0
    while True:
        outcome = _attempt(job, identity, means)
        attempts, seconds = attempts + 1, seconds + outcome.seconds
        if outcome.cause not in PASSING or means.stop.is_set() or attempts > job.retry:
            return replace(outcome, attempts=attempts, seconds=round(seconds, 2))


def _require_own(job: Job, record: Record | None) -> None:
    """Refuse to replace what is not this batch's own."""
    if job.overwrite:
        return
    for name in job.file_names().values():
        found = hash_if_there(job.output / name)
        if found is not None and (record is None or not record.knows(name, found)):
            raise OutputError(
                f"{job.output / name} exists already and was not written by this batch, or was changed since; "
                "choose another folder or add --overwrite."
            )


def _attempt(job: Job, identity: dict[str, Any], means: _Means) -> Outcome:
    job.log().parent.mkdir(parents=True, exist_ok=True)
    with _own_folder(job) as folder:
        if "config" in job.kinds:
            (folder / "files" / job.file_names()["config"]).write_text(job.config, encoding="utf-8")
        end = attempt(
            _argument(job, folder),
            threads=job.options["threads"],
            log=job.log(),
            environment={"TMPDIR": str((folder / "temporary").absolute()), **means.environment},
            limits=job.limits,
            stop=means.stop,
            work=means.work,
        )
        if end.cause is not None:
            return _failed(job, end.cause, _sentence(end, folder), end.exit_code, end)
        return replace(_adopt(job, folder, identity, end), seconds=end.seconds)


@contextmanager
def _own_folder(job: Job) -> Iterator[Path]:
    """A folder that is gone afterwards, with the folders that the files' names need."""
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
    """What the child is asked to do, as plain values."""
    files = {kind: f"files/{name}" for kind, name in job.file_names().items()}
    return {
        "name": job.name,
        "folder": str(folder.absolute()),
        "scan": str(job.scan),
        "files": {"report": REPORT, **files, "thumbnail": THUMBNAIL},
        "options": dict(job.options),
        "reference": None if job.reference is None else str(job.reference),
        "command": _command(job),
    }


def _command(job: Job) -> str:
    """What makes the same mesh again."""
    paths = {kind: str(job.output / name) for kind, name in job.file_names().items()}
    config = ["--config", paths["config"]] if "config" in paths else []
    return shlex.join(["gnrecon", str(job.scan), "-o", paths["mesh"], *config])


def _sentence(end: End, folder: Path) -> str:
    if end.message:
        return end.message
    try:
        return (folder / FAILURE).read_text(encoding="utf-8")
    except OSError:
        return f"Its process ended with exit code {end.exit_code}."


def _adopt(job: Job, folder: Path, identity: dict[str, Any], end: End) -> Outcome:
    """Record a result, then let its files have their names."""
    names = job.file_names()
    report = folder / (f"files/{names['report']}" if "report" in names else REPORT)
    told = json.loads(report.read_text(encoding="utf-8"))
    facts = {"figures": figures_of(told), "metrics": told["metrics"], "peak_memory_mb": end.peak_memory_mb}
    job.thumbnail().parent.mkdir(parents=True, exist_ok=True)
    (folder / THUMBNAIL).replace(job.thumbnail())
    found = {name: hash_if_there(job.output / name) for name in names.values()}
    record = Record(
        identity,
        {name: file_hash(folder / "files" / name) for name in names.values()},
        {name: known for name, known in found.items() if known is not None},
        (folder / "files").relative_to(job.output).as_posix(),
        facts,
    )
    record.write(job.record())
    record.place(job.output)
    sync(job.output)
    return _told(job, Status.MADE, facts)


def _told(job: Job, status: Status, told: Mapping[str, Any]) -> Outcome:
    """The outcome of a result that is there, from what its record tells."""
    files = {kind: str(job.output / name) for kind, name in job.file_names().items()}
    return Outcome(
        job.name,
        str(job.scan),
        status,
        files=files,
        thumbnail=str(job.thumbnail()),
        log=str(job.log()),
        **told,
    )


def _failed(job: Job, cause: Cause | None, message: str, exit_code: int | None, end: End | None = None) -> Outcome:
    log = str(job.log()) if job.log().is_file() else ""
    return Outcome(
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


LOOK = 0.1
"""Seconds between two looks at a child."""

_SELDOM = 10
"""Looks between two searches for what a child has started."""

_PATIENCE = 5.0


# One attempt at a piece of work in a child process, within limits of time and memory.
#
# Memory is watched from outside, as the resident memory of the child and all that it has started: a limit of address
# space (``RLIMIT_AS``) would also count what torch and CUDA merely reserve.


@dataclass(frozen=True)
class End:
    """How an attempt ended.

    Parameters
    ----------
    cause : why it failed; None where it went well
    exit_code : of the child; None where it was ended for another reason than its memory
    message : a sentence, where the child itself could not say one
    peak_memory_mb : greatest resident memory that was seen, in MB of 10^6 bytes
    seconds : from the child's start to its end
    """

    cause: Cause | None
    exit_code: int | None
    message: str
    peak_memory_mb: float
    seconds: float


def attempt(
    argument: Mapping[str, Any],
    *,
    threads: int,
    log: Path,
    environment: Mapping[str, str],
    limits: Limits,
    stop: Stop | None = None,
    work: str = WORK,
) -> End:
    """Do a piece of work in a child process and wait for its end, or bring it about.

    Where the process that starts the children was itself ended from outside, it is started again, and so is the work.

    Parameters
    ----------
    argument : of the work, plain values
    threads : of the numerical libraries
    log : file for what the child says
    environment : variables that the child is to have
    limits : Limits
    stop : set by the caller when the child is to end now
    work : module with ``work(argument) -> exit code``

    Raises
    ------
    ForkerError
        When no child can be started, or the process that starts them has ended twice.
    """
    once = partial(_once, argument, threads, log, environment, limits, stop or threading.Event(), work)
    try:
        return once()
    except ForkerError:
        return once()


def _once(
    argument: Mapping[str, Any],
    threads: int,
    log: Path,
    environment: Mapping[str, str],
    limits: Limits,
    stop: Stop,
    work: str,
) -> End:
    with start_child(threads, argument, log, environment, work) as child:
        start, peak, watched = time.monotonic(), 0.0, Watched(child.pid)
        while (status := child.wait(LOOK)) is None:
            memory, seconds = watched.memory_mb(), round(time.monotonic() - start, 3)
            peak = max(peak, round(memory, 1))
            if stop.is_set():
                return _killed(child, End(Cause.INTERRUPTED, ExitCode.INTERRUPTED, "Interrupted.", peak, seconds))
            if limits.memory_mb is not None and memory > limits.memory_mb:
                said = f"It needed {memory:,.0f} MB of memory; the limit is {limits.memory_mb:,.0f} MB (--memory)."
                return _killed(child, End(Cause.MEMORY, ExitCode.MEMORY, said, peak, seconds))
            if limits.seconds is not None and seconds > limits.seconds:
                said = f"It had not ended after {limits.seconds:g} s, which is the limit (--timeout)."
                return _killed(child, End(Cause.TIMEOUT, None, said, peak, seconds))
        seconds = round(time.monotonic() - start, 3)
    message = describe_signal(-status) if status < 0 else ""
    return End(cause_of(status), status, message, peak, seconds)


def _killed(child: Child, end: End) -> End:
    """Kill a child with all that it has started, and wait until it has gone."""
    for process in _tree(child.pid):
        with suppress(psutil.Error):
            process.kill()
    with suppress(ForkerError):
        child.wait(_PATIENCE)
    return end


class Watched:
    """A process whose memory is looked at again and again.

    What it has started is looked for now and then only, because that takes a look at every process of the machine.
    """

    def __init__(self, pid: int) -> None:
        self._pid, self._looks = pid, 0
        self._tree: list[psutil.Process] = []

    def memory_mb(self) -> float:
        """Return the resident memory of it and its descendants, in MB of 10^6 bytes; 0 when it has ended."""
        if self._looks % _SELDOM == 0:
            self._tree = _tree(self._pid)
        self._looks += 1
        total = 0
        for process in self._tree:
            with suppress(psutil.Error):
                total += process.memory_info().rss
        return total / 1e6


def _tree(pid: int) -> list[psutil.Process]:
    try:
        process = psutil.Process(pid)
        return [process, *process.children(recursive=True)]
    except psutil.Error:
        return []
