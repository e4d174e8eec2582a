"""A whole batch: plan it, do it, show how far it is, and write its account."""

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
from gnrecon.batch.job import STATE, Outcome, Status, all_records, running_folder
from gnrecon.batch.plan import plan
from gnrecon.batch.progress_board import Board
from gnrecon.batch.request import Request
from gnrecon.batch.summary import NAME, Account, write_summary
from gnrecon.runtime.errors import ExitCode, OutputError, UsageError


def run_batch(request: Request) -> int:
    """Reconstruct all scans that are asked for, each in a process of its own, and return the exit code.

    Work that was done before is not done again. Beside the meshes lies the account of the whole, see
    `gnrecon.batch.summary`, also where the batch was interrupted.

    Raises
    ------
    InputError
        When a source is missing, or there is no scan.
    UsageError
        When options, names or formats make no sense, or another batch is at work in the output folder.
    OutputError
        When the output folder cannot be made, or the account not be written.
    """
    jobs = plan(request)
    devices = cuda_devices(jobs)
    threads = max(int(job.options["threads"]) for job in jobs)
    console, start = Console(stderr=True, quiet=request.quiet), time.monotonic()
    outcomes: dict[str, Outcome] = {}
    interrupted = False
    with workplace(request.output):
        count = request.jobs or len(devices) or fitting_jobs(jobs, threads)
        without = sum(job.reference is None for job in jobs)
        if request.references is not None and without:
            console.print(f"{without} of {len(jobs)} scans have no reference in {request.references}.", soft_wrap=True)
        board = Board(console, len(jobs), request.output)

        def done(outcome: Outcome) -> None:
            outcomes[outcome.name] = outcome
            board.done(outcome)

        try:
            with board.shown():
                if request.engine == "dask" or request.scheduler is not None:
                    run_on_cluster(jobs, request.scheduler, count, devices, done)
                else:
                    run_locally(jobs, count, devices, done)
        except KeyboardInterrupt:  # What was done until now is still worth its account.
            interrupted = True
        ordered = tuple(outcomes[job.name] for job in jobs if job.name in outcomes)
        account = Account(ordered, len(jobs), count, threads, time.monotonic() - start, request.command)
        write_summary(account, request.output)
    for line in _closing(account):
        console.print(line, highlight=False, markup=False)
    if interrupted:
        told = request.output / f"{NAME}.json"
        print(f"gnrecon: Interrupted; {told} tells what was done until then.", file=sys.stderr)
        return ExitCode.INTERRUPTED
    return ExitCode.BATCH if account.count(Status.FAILED) else ExitCode.OK


def _closing(account: Account) -> list[RenderableType]:
    """A line of figures, and the failures."""
    made, unchanged = account.count(Status.MADE), account.count(Status.UNCHANGED)
    line = f"{made + unchanged} of {account.total} scans reconstructed"
    line += f", {unchanged} of them unchanged" if unchanged else ""
    line += f", in {account.seconds:.0f} s"
    if not account.count(Status.FAILED):
        return [f"{line}."]
    causes = ", ".join(f"{count} {cause}" for cause, count in account.causes().items())
    table = Table()
    for heading in ("scan", "cause", "seconds", "what happened"):
        table.add_column(heading, overflow="fold")
    for outcome in account.outcomes:
        if outcome.failed:
            table.add_row(outcome.scan, str(outcome.cause), f"{outcome.seconds:.1f}", outcome.message)
    return [table, f"{line}; failed: {causes}."]


# The output folder of a batch: made, held by one batch at a time, and freed of what an earlier one left half done.


@contextmanager
def workplace(output: Path) -> Iterator[None]:
    """Hold an output folder while the block runs; the system lets go of it even when this process is killed.

    Raises
    ------
    OutputError
        When it cannot be made or written to.
    UsageError
        When another batch is at work there.
    """
    try:
        (output / STATE).mkdir(parents=True, exist_ok=True)
        lock = (output / STATE / "lock").open("w", encoding="utf-8")
    except OSError as error:
        raise OutputError(f"The folder {output} cannot be made: {error.strerror or error}.") from error
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise UsageError(
                f"Another batch is at work in {output}; wait for its end, or choose another folder."
            ) from None
        for record in all_records(output / STATE / "records"):
            record.place(output)
        shutil.rmtree(running_folder(output), ignore_errors=True)
        for left in (output / STATE / "records").rglob(".*.json"):
            left.unlink(missing_ok=True)
        yield
