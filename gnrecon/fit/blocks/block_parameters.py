"""Parameters of fits that are solved by blocks."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class BlockParameters:
    """How a large scan is divided into blocks, and these among processes.

    The result depends on none of them.
    """

    large_scan_points: int = 200_000  # from which on a scan is fitted by blocks
    process_points: int = 10_000  # from which on processes solve the local fields: threads hinder each other in Python,
    # and to import libraries once more takes more than a second of a processor
    block_points: int = 10_000  # of a block at most, unless one group of cubes holds more: some seconds of work
    least_blocks: int = 20  # of a scan of many groups, so that all processes end at about the same time
    lookup_points: int = 100_000  # whose cubes are looked up at a time, to bound the memory
    worker_bytes: float = 1.2e9  # memory of a process at most, with Python and torch
    task_retries: int = 2  # of a block on a cluster, where a network file system shows files late
