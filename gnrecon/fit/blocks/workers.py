"""Solves blocks in parallel: in local processes with one thread each, or on the workers of a Dask cluster.

The local processes are plain programs that read block numbers from pipes (`worker`), so that the caller's program is
not imported again and needs no ``__main__`` guard. They take a second to import their libraries, so that they are
started before their work is known (`workers_for`). If a process dies, the fit fails with an error; the blocks solved
until then stay in the work folder. On a cluster, Dask gives the blocks of a lost worker to others; a block that is
solved twice, because its worker was only thought lost, does no harm, as its result is one file.
"""

from __future__ import annotations

import json
import os
import secrets
import selectors
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from io import FileIO
from pathlib import Path
from typing import TextIO

from gnrecon.fit.blocks.block import solve_block
from gnrecon.fit.blocks.block_parameters import BlockParameters
from gnrecon.fit.blocks.store import WorkFolder
from gnrecon.fit.blocks.worker import DONE
from gnrecon.runtime.dask_scheduler import dask_client, require_distributed
from gnrecon.runtime.errors import FitError, MemoryLimitError
from gnrecon.runtime.parallel import fixed_sums, torch_threads, worker_count
from gnrecon.runtime.progress import ProgressCallback


@dataclass(frozen=True)
class Workers:
    """Processes that solve blocks; they may still be starting.

    Parameters
    ----------
    first : the process that has forked the others
    pipes : for each, where blocks are requested, and where it answers
    """

    first: subprocess.Popen[bytes]
    pipes: Sequence[tuple[FileIO, TextIO]]

    def solve(self, folder: Path, blocks: Sequence[int], advance: ProgressCallback) -> None:
        """Solve blocks of a work folder; see `solve_blocks` for the errors."""
        waiting, solved = iter(blocks), 0
        with selectors.DefaultSelector() as answers:
            for pipe, block in zip(self.pipes, waiting, strict=False):
                answers.register(pipe[1], selectors.EVENT_READ, pipe)
                _request(pipe[0], folder, block)
            while solved < len(blocks):
                for key, _ in answers.select():
                    requests, answer = key.data
                    self._require_done(answer.readline().strip())
                    solved += 1
                    advance(solved / len(blocks))
                    if (block := next(waiting, -1)) >= 0:
                        _request(requests, folder, block)

    def _require_done(self, answer: str, *, exit_seconds: float = 10.0) -> None:
        """Raise the error of an answer; an empty one is that of a process that has died."""
        if answer == DONE:
            return
        if answer:
            raise FitError(f"A block could not be solved: {answer}.")
        try:
            # The first process ends as the one that died.
            status = self.first.wait(exit_seconds)
        except subprocess.TimeoutExpired:
            raise FitError("A process that solved blocks has ended.") from None
        # A negative status is the number of the signal that killed the process.
        if status < 0:
            raise MemoryLimitError(
                f"A process that solved blocks was killed by signal {-status}, probably because memory ran out; "
                f"use fewer threads (--threads) or points (--max-points)."
            )
        raise FitError(f"A process that solved blocks ended with status {status}.")


def _request(requests: FileIO, folder: Path, block: int) -> None:
    # A process that has died does not answer, and its status says why.
    with suppress(BrokenPipeError):
        requests.write(json.dumps([str(folder), block]).encode() + b"\n")


@contextmanager
def started_workers(count: int, *, exit_seconds: float = 10.0) -> Iterator[Workers]:
    """Start processes, do not wait until they are ready, and end them with the block."""
    import gnrecon

    # The same package as here, from wherever it was imported; the worker limits torch and OpenBLAS itself.
    package = str(Path(str(gnrecon.__file__)).parents[1])
    paths = [package, *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1"}
    with ExitStack() as ours, ExitStack() as theirs:
        pipes, pairs = list[tuple[FileIO, TextIO]](), list[tuple[int, int]]()
        for _ in range(count):
            (requests, send), (receive, answers) = os.pipe(), os.pipe()
            for descriptor in (requests, answers):
                theirs.callback(os.close, descriptor)
            back = ours.enter_context(os.fdopen(receive, encoding="utf-8"))
            pipes.append((ours.enter_context(FileIO(send, "w")), back))
            pairs.append((requests, answers))
        first = subprocess.Popen(
            [sys.executable, "-m", "gnrecon.fit.blocks.worker", *(f"{one},{other}" for one, other in pairs)],
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            pass_fds=[descriptor for pair in pairs for descriptor in pair],
        )
        theirs.close()
        try:
            yield Workers(first, pipes)
        finally:
            # It ends the others, too.
            first.terminate()
            try:
                first.wait(exit_seconds)
            except subprocess.TimeoutExpired:
                first.kill()
                first.wait()


@contextmanager
def workers_for(device: str) -> Iterator[Workers | None]:
    """Start as many processes as there are threads, or yield None where this process solves blocks alone.

    It does so with one thread, where memory is short, on a GPU, which processes would share, and on Windows, which
    cannot fork.
    """
    processes = min(worker_count(), _affordable_processes())
    if device != "cpu" or processes < 2 or not hasattr(os, "fork"):
        yield None
        return
    with started_workers(processes) as workers:
        yield workers


def solve_blocks(
    work: WorkFolder, blocks: Sequence[int], workers: Workers | None, device: str, advance: ProgressCallback
) -> None:
    """Solve blocks of a work folder.

    Parameters
    ----------
    work : WorkFolder
    blocks : their numbers
    workers : that solve them; by default this process, one after the other
    device : a torch device
    advance : called with the share of the blocks that is done

    Raises
    ------
    FitError
        When a block cannot be solved.
    MemoryLimitError
        When a process was killed, as the system does where memory runs out.
    """
    if workers is not None:
        workers.solve(work.folder, blocks, advance)
        return
    with torch_threads(1):
        for number, block in enumerate(blocks, 1):
            solve_block(work.folder, block, device)
            advance(number / len(blocks))


def _affordable_processes(*, worker_bytes: float = BlockParameters.worker_bytes) -> int:
    """Return how many processes of `worker_bytes` fit into free memory; at least one."""
    import psutil

    return max(1, int(psutil.virtual_memory().available / worker_bytes))


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
