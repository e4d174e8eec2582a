"""The output folder of a batch: made, held by one batch at a time, and freed of what an earlier one left half done."""

from __future__ import annotations

import fcntl
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gnrecon.batch.job import STATE, running_folder
from gnrecon.batch.record import all_records
from gnrecon.runtime.errors import OutputError, UsageError


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
