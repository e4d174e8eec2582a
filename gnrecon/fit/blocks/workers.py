"""Blocks solved side by side, in processes of their own, each with one thread.

The processes are plain programs that are given block numbers by a pipe (`worker`), so that nothing of the caller's own
program is imported again, and a library that calls for a large fit needs no guard against that. A process that dies
ends the fit with a sentence; what was solved until then stays in the work folder.
"""

from __future__ import annotations

import os
import secrets
import selectors
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from gnrecon.fit.blocks.block import solve_block
from gnrecon.fit.blocks.store import Work
from gnrecon.fit.blocks.worker import DONE
from gnrecon.runtime.dask_scheduler import dask_client, require_distributed
from gnrecon.runtime.errors import FitError, MemoryLimitError
from gnrecon.runtime.parallel import torch_threads
from gnrecon.runtime.progress import ProgressCallback

NEED = 1.2e9
"""Bytes that a process needs at most, with Python and torch; no more processes are started than have room."""

Process = subprocess.Popen[str]


def solve_blocks(work: Work, blocks: Sequence[int], processes: int, device: str, advance: ProgressCallback) -> None:
    """Solve blocks of a work folder, in this process where one is enough, or where a GPU is shared.

    Parameters
    ----------
    work : Work
    blocks : their numbers
    processes : most that may work at a time
    device : a torch device
    advance : told of the share of the blocks that is done

    Raises
    ------
    FitError
        When a block cannot be solved.
    MemoryLimitError
        When a process was killed, as the system does where memory runs out.
    """
    processes = min(processes, len(blocks), _room())
    if processes > 1 and device == "cpu":
        _solve_beside(work.folder, blocks, processes, advance)
        return
    with torch_threads(1):
        for number, block in enumerate(blocks, 1):
            solve_block(work.folder, block, device)
            advance(number / len(blocks))


def _room() -> int:
    """How many processes the free memory has room for; at least one."""
    import psutil

    return max(1, int(psutil.virtual_memory().available / NEED))


def _solve_beside(folder: Path, blocks: Sequence[int], processes: int, advance: ProgressCallback) -> None:
    waiting, done = iter(blocks), 0
    with _started(folder, processes) as workers, selectors.DefaultSelector() as answers:
        for worker in workers:
            assert worker.stdout is not None
            answers.register(worker.stdout, selectors.EVENT_READ, worker)
            _give(worker, next(waiting))
        while done < len(blocks):
            for key, _ in answers.select():
                _require_done(key.data)
                done += 1
                advance(done / len(blocks))
                block = next(waiting, None)
                if block is not None:
                    _give(key.data, block)


@contextmanager
def _started(folder: Path, count: int) -> Iterator[list[Process]]:
    """Start processes, and see to it that none outlives the block."""
    import gnrecon

    # The same package as here, from wherever it was imported, and one thread also in libraries beside torch.
    package = str(Path(str(gnrecon.__file__)).parents[1])
    paths = [package, *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "gnrecon.fit.blocks.worker", str(folder)]
    pipe, workers = subprocess.PIPE, list[Process]()
    try:
        for _ in range(count):
            workers.append(
                subprocess.Popen(
                    command, env=environment, text=True, stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL
                )
            )
        yield workers
    finally:
        for worker in workers:
            worker.kill()
            worker.communicate()


def _give(worker: Process, block: int) -> None:
    assert worker.stdin is not None
    try:
        print(block, file=worker.stdin, flush=True)
    except BrokenPipeError:
        _require_done(worker)


def _require_done(worker: Process) -> None:
    """Read the answer of a process; anything but that it is done ends the fit."""
    assert worker.stdout is not None
    answer = worker.stdout.readline().strip()
    if answer == DONE:
        return
    if answer:
        raise FitError(f"A block could not be solved: {answer}.")
    status = worker.wait()
    if status < 0:
        raise MemoryLimitError(
            f"A process that solved blocks was killed by signal {-status}, most likely for want of memory; use fewer "
            f"threads (--threads) or points (--max-points)."
        )
    raise FitError(f"A process that solved blocks ended with status {status}.")


RETRIES = 2
"""How often a block is begun again that raised an error, as where a network file system shows files late."""


# Blocks solved by the workers of a Dask cluster, which see the work folder by the same path.
#
# Dask gives the blocks of a lost worker to others. What a block leaves is its file in the work folder, so that one that
# is solved twice, as by a worker that was only thought lost, does no harm.


def solve_scheduled(work: Work, blocks: Sequence[int], address: str, advance: ProgressCallback) -> None:
    """Solve blocks of a work folder on a cluster, as many at a time as its workers have threads.

    Whatever ends this function early, such as Ctrl-C, calls back the blocks that are still waiting.

    Parameters
    ----------
    work : in a folder that all workers see
    blocks : their numbers
    address : of the scheduler, such as ``tcp://host:8786``
    advance : told of the share of the blocks that is done

    Raises
    ------
    UsageError
        When Dask is not installed, or the scheduler does not answer.
    FitError
        When a block cannot be solved.
    """
    folder, run = str(work.folder.absolute()), secrets.token_hex(4)
    with dask_client(address) as client, client.as_current():
        futures = [
            client.submit(on_worker, folder, block, key=f"gnrecon-block-{run}-{block}", retries=RETRIES)
            for block in blocks
        ]
        try:
            for count, future in enumerate(require_distributed().as_completed(futures), 1):
                if future.status != "finished":
                    error = " ".join(str(future.exception()).split()).rstrip(".")
                    raise FitError(f"The cluster could not solve a block: {error or future.status}.")
                advance(count / len(blocks))
        except BaseException:
            client.cancel(futures)
            raise


def on_worker(folder: str, block: int) -> None:
    """Solve a block on a worker, with one thread, because sums by several differ in their last digits."""
    with torch_threads(1):
        solve_block(folder, block)
