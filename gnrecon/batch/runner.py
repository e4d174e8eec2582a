"""Runs a whole batch: plans it, runs its jobs, shows the progress, and writes the summary."""

from __future__ import annotations

import fcntl
import shutil
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console, RenderableType
from rich.table import Table

from gnrecon.batch.executors import cuda_devices, fitting_jobs, run_locally, run_on_cluster
from gnrecon.batch.job import (
    SUMMARY_FILES,
    JobOutcome,
    Status,
    all_records,
    records_folder,
    running_folder,
    state_folder,
)
from gnrecon.batch.plan import plan
from gnrecon.batch.progress_board import ProgressBoard
from gnrecon.batch.request import Request
from gnrecon.batch.summary import BatchSummary, write_summary
from gnrecon.runtime.errors import ExitCode, OutputError, UsageError
from gnrecon.runtime.files import one_line
from gnrecon.runtime.interrupts import ignore_interrupts
from gnrecon.runtime.memory_budget import require_room_for_libraries


def run_batch(request: Request, *, least_addresses_mb: float = 2000.0) -> int:
    """Reconstruct all requested scans, each in a process of its own, and return the exit code.

    Scans whose result is current are skipped. The summary is written to the output folder, see `gnrecon.batch.summary`,
    also where the batch was interrupted.

    Parameters
    ----------
    request : Request
    least_addresses_mb : that a process with all libraries and some work takes (measured: 1,640 MB and 270 MB)

    Raises
    ------
    InputError
        When a source is missing, or there is no scan.
    UsageError
        When options, names or formats are invalid, or another batch is running in the output folder.
    OutputError
        When the output folder cannot be created, or the summary cannot be written.
    MemoryLimitError
        When the limit of the shell leaves less than `least_addresses_mb`.
    """
    _require_own_summary(request)
    jobs = plan(request)
    require_room_for_libraries(least_addresses_mb, in_new_process=True)
    devices = cuda_devices(jobs)
    threads = max(int(job.options["threads"]) for job in jobs)
    console, start = Console(stderr=True, quiet=request.quiet), time.monotonic()
    outcomes: dict[str, JobOutcome] = {}
    interrupted = False
    with locked_output_folder(request.output):
        count = request.jobs or len(devices) or fitting_jobs(jobs, threads)
        without = sum(job.reference is None for job in jobs)
        if request.references is not None and without:
            console.print(f"{without} of {len(jobs)} scans have no reference in {request.references}.", soft_wrap=True)
        reserve = _reserved_space(request.output, len(jobs))
        board = ProgressBoard(console, len(jobs), request.output)

        def done(outcome: JobOutcome) -> None:
            outcomes[outcome.name] = outcome
            board.done(outcome)

        try:
            with board.shown():
                if request.engine == "dask" or request.scheduler is not None:
                    run_on_cluster(jobs, request.scheduler, count, devices, done)
                else:
                    run_locally(jobs, count, devices, done)
        except KeyboardInterrupt:  # the summary still lists what was finished
            interrupted = True
        ignore_interrupts()  # a second one, or one that comes only now, does not cost the summary
        ordered = tuple(outcomes[job.name] for job in jobs if job.name in outcomes)
        summary = BatchSummary(ordered, len(jobs), count, threads, time.monotonic() - start, request.command)
        reserve.unlink(missing_ok=True)
        try:
            written = write_summary(summary, request.output)
        finally:
            for line in _closing_lines(summary):
                console.print(line, highlight=False, markup=False)
    if interrupted:
        print(f"gnrecon: Interrupted; {written} lists what was done until then.", file=sys.stderr)
        return ExitCode.INTERRUPTED
    return ExitCode.BATCH if summary.count(Status.FAILED) else ExitCode.OK


def _require_own_summary(request: Request) -> None:
    """Refuse a folder whose name the system does not take, and to replace a summary's files where no batch has run."""
    try:
        new = not state_folder(request.output).is_dir()
    except OSError as error:
        raise OutputError(f"The folder {request.output} cannot be created: {error.strerror}.") from error
    for name in SUMMARY_FILES:
        if new and not request.overwrite and (path := request.output / name).is_file():
            raise OutputError(
                f"{path} exists already and was not written by a batch, but the summary would replace it; choose "
                "another folder or add --overwrite."
            )


def _reserved_space(output: Path, scans: int, *, least_bytes: int = 1 << 18, scan_bytes: int = 1 << 15) -> Path:
    """Fill a file with as much as the summary needs, so that it finds space where the results filled the disk.

    `scan_bytes` is about twice the size of a scan's thumbnail and figures in the three formats.

    Raises
    ------
    OutputError
        When there is not even that much space.
    """
    path = state_folder(output) / "reserve"
    try:
        path.write_bytes(b"\0" * (least_bytes + scans * scan_bytes))
    except OSError as error:
        path.unlink(missing_ok=True)
        raise OutputError(f"The folder {output} has no space for the summary: {error.strerror or error}.") from error
    return path


def _closing_lines(summary: BatchSummary) -> list[RenderableType]:
    """A line of figures, and a table of the failures."""
    made, unchanged = summary.count(Status.MADE), summary.count(Status.UNCHANGED)
    line = f"{made + unchanged} of {summary.total} scans reconstructed"
    line += f", {unchanged} of them unchanged" if unchanged else ""
    line += f", in {summary.seconds:.0f} s"
    if not summary.count(Status.FAILED):
        return [f"{line}."]
    causes = ", ".join(f"{count} {cause}" for cause, count in summary.causes().items())
    table = Table()
    for heading in ("scan", "cause", "seconds", "what happened"):
        table.add_column(heading, overflow="fold")
    for outcome in summary.outcomes:
        if outcome.failed:
            names = one_line(outcome.scan), one_line(outcome.message)
            table.add_row(names[0], str(outcome.cause), f"{outcome.seconds:.1f}", names[1])
    return [table, f"{line}; failed: {causes}."]


@contextmanager
def locked_output_folder(output: Path) -> Iterator[None]:
    """Create an output folder and lock it while the block runs; the system unlocks it even if this process is killed.

    Results of an earlier batch that were recorded but not yet in place are moved there; its other leftovers are
    deleted.

    Raises
    ------
    OutputError
        When it cannot be created or written to.
    UsageError
        When another batch is running there.
    """
    try:
        state_folder(output).mkdir(parents=True, exist_ok=True)
        lock = (state_folder(output) / "lock").open("w", encoding="utf-8")
    except OSError as error:
        raise OutputError(f"The folder {output} cannot be created: {error.strerror or error}.") from error
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise UsageError(
                f"Another batch is running in {output}; wait for its end, or choose another folder."
            ) from None
        for record in all_records(output):
            record.move_into_place(output)
        # After the recorded results were moved, these folders only hold files of killed attempts.
        shutil.rmtree(running_folder(output), ignore_errors=True)
        for incomplete in records_folder(output).rglob(".*.json"):
            incomplete.unlink(missing_ok=True)
        yield
