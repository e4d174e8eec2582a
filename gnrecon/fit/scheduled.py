"""Blocks solved by the workers of a Dask cluster, which see the work folder by the same path.

Dask gives the blocks of a lost worker to others. What a block leaves is its file in the work folder, so that one that
is solved twice, as by a worker that was only thought lost, does no harm.
"""

from __future__ import annotations

import secrets
from collections.abc import Sequence

from gnrecon.fit.block import solve_block
from gnrecon.fit.work import Work
from gnrecon.runtime.errors import FitError
from gnrecon.runtime.parallel import connected, having_threads, require_distributed
from gnrecon.runtime.progress import Advance

RETRIES = 2
"""How often a block is begun again that raised an error, as where a network file system shows files late."""


def solve_scheduled(work: Work, blocks: Sequence[int], address: str, advance: Advance) -> None:
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
    with connected(address) as client, client.as_current():
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
    with having_threads(1):
        solve_block(folder, block)
