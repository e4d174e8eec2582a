"""Solves blocks in parallel: in local processes with one thread each, or on the workers of a Dask cluster.

The local processes are plain programs that read block numbers from a pipe (`worker`), so that the caller's program is
not imported again and needs no ``__main__`` guard. If a process dies, the fit fails with an error; the blocks solved
until then stay in the work folder. On a cluster, Dask gives the blocks of a lost worker to others; a block that is
solved twice, because its worker was only thought lost, does no harm, as its result is one file.
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
from gnrecon.fit.blocks.block_parameters import BlockParameters
from gnrecon.fit.blocks.store import WorkFolder
from gnrecon.fit.blocks.worker import DONE
from gnrecon.runtime.dask_scheduler import dask_client, require_distributed
from gnrecon.runtime.errors import FitError, MemoryLimitError
from gnrecon.runtime.parallel import fixed_sums, torch_threads
from gnrecon.runtime.progress import ProgressCallback

Process = subprocess.Popen[str]


def solve_blocks(
    work: WorkFolder, blocks: Sequence[int], processes: int, device: str, advance: ProgressCallback
) -> None:
    """Solve blocks of a work folder, in this process if one is enough, or on a GPU, which processes would share.

    Parameters
    ----------
    work : WorkFolder
    blocks : their numbers
    processes : that may run at a time
    device : a torch device
    advance : called with the share of the blocks that is done

    Raises
    ------
    FitError
        When a block cannot be solved.
    MemoryLimitError
        When a process was killed, as the system does where memory runs out.
    """
    processes = min(processes, len(blocks), _affordable_processes())
    if processes > 1 and device == "cpu":
        _solve_in_processes(work.folder, blocks, processes, advance)
        return
    with torch_threads(1):
        for number, block in enumerate(blocks, 1):
            solve_block(work.folder, block, device)
            advance(number / len(blocks))


def _affordable_processes(*, worker_bytes: float = BlockParameters.worker_bytes) -> int:
    """Return how many processes of `worker_bytes` fit into free memory; at least one."""
    import psutil

    return max(1, int(psutil.virtual_memory().available / worker_bytes))


def _solve_in_processes(folder: Path, blocks: Sequence[int], processes: int, advance: ProgressCallback) -> None:
    waiting, solved = iter(blocks), 0
    with _started(folder, processes) as workers, selectors.DefaultSelector() as answers:
        for worker in workers:
            assert worker.stdout is not None
            answers.register(worker.stdout, selectors.EVENT_READ, worker)
            _send(worker, next(waiting))
        while solved < len(blocks):
            for key, _ in answers.select():
                _require_done(key.data)
                solved += 1
                advance(solved / len(blocks))
                block = next(waiting, None)
                if block is not None:
                    _send(key.data, block)


@contextmanager
def _started(folder: Path, count: int) -> Iterator[list[Process]]:
    """Start processes, and kill those that are left at the end."""
    import gnrecon

    # The same package as here, from wherever it was imported; the worker limits torch and OpenBLAS itself.
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


def _send(worker: Process, block: int) -> None:
    assert worker.stdin is not None
    try:
        print(block, file=worker.stdin, flush=True)
    except BrokenPipeError:  # the process has died; its status says why
        _require_done(worker)


def _require_done(worker: Process) -> None:
    """Read the answer of a process, and raise any error."""
    assert worker.stdout is not None
    answer = worker.stdout.readline().strip()
    if answer == DONE:
        return
    if answer:
        raise FitError(f"A block could not be solved: {answer}.")
    status = worker.wait()
    # A negative status is the number of the signal that killed the process.
    if status < 0:
        raise MemoryLimitError(
            f"A process that solved blocks was killed by signal {-status}, probably because memory ran out; "
            f"use fewer threads (--threads) or points (--max-points)."
        )
    raise FitError(f"A process that solved blocks ended with status {status}.")


def solve_on_cluster(
    work: WorkFolder,
    blocks: Sequence[int],
    address: str,
    advance: ProgressCallback,
    *,
    retries: int = BlockParameters.task_retries,
) -> None:
    """Solve blocks of a work folder on a Dask cluster, as many at a time as its workers have threads.

    Waiting blocks are cancelled when this function ends early, as by Ctrl-C.

    Parameters
    ----------
    work : in a folder that all workers see by the same path
    blocks : their numbers
    address : of the scheduler, such as ``tcp://host:8786``
    advance : called with the share of the blocks that is done
    retries : of a block that raised an error

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
            client.submit(solve_on_worker, folder, block, key=f"gnrecon-block-{run}-{block}", retries=retries)
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


def solve_on_worker(folder: str, block: int) -> None:
    """Solve a block on a worker, with one thread: sums of several threads differ in their last digits."""
    with fixed_sums(1):
        solve_block(folder, block)
