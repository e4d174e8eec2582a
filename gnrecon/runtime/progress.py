"""Progress callbacks: long computations call them with the share that is done, and a callback may end them.

A callback is called between larger steps, so it costs next to nothing. Whatever it raises, such as
`gnrecon.runtime.errors.Cancelled`, ends the computation.
"""

from __future__ import annotations

from collections.abc import Callable

ProgressCallback = Callable[[float], None]
"""Called with the share of the work that is done, from 0 to 1, never decreasing."""


def ignore_progress(share: float) -> None:
    """Do nothing."""


def subrange(advance: ProgressCallback, begin: float, end: float) -> ProgressCallback:
    """Return a callback for one part of the work, which takes it from the share `begin` to `end`."""
    return lambda share: advance(begin + (end - begin) * share)
