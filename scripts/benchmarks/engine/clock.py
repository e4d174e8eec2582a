"""Timing: of one call, and of a run that is interrupted to look at it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from time import perf_counter
from typing import TypeVar

import torch

Result = TypeVar("Result")


def timed(call: Callable[[], Result], device: str = "cpu") -> tuple[float, Result]:
    """Return the seconds that a call takes, with all that it started on the device, and its result."""
    finish(device)
    start = perf_counter()
    result = call()
    finish(device)
    return perf_counter() - start, result


def finish(device: str) -> None:
    """Wait until the device has nothing left to do."""
    if device == "cuda":
        torch.cuda.synchronize()


class Clock:
    """Seconds since it was made, without those of its pauses."""

    def __init__(self) -> None:
        self._start = perf_counter()
        self._paused = 0.0

    @property
    def seconds(self) -> float:
        """Seconds so far."""
        return perf_counter() - self._start - self._paused

    @contextmanager
    def pause(self) -> Iterator[None]:
        """Leave a block's seconds out."""
        start = perf_counter()
        yield
        self._paused += perf_counter() - start
