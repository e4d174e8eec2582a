"""How far a piece of work is: a function that the work calls now and then, which may also end it.

The one who asks for the work gives the function; the work calls it between its larger pieces, so that it costs nothing
to speak of. Whatever it raises, such as `gnrecon.runtime.errors.Cancelled`, ends the work there and then.
"""

from __future__ import annotations

from collections.abc import Callable

ProgressCallback = Callable[[float], None]
"""Told the share of the work that is done, from 0 to 1 and never less than before."""


def ignore_progress(share: float) -> None:
    """Take no notice."""


def part(advance: ProgressCallback, begin: float, end: float) -> ProgressCallback:
    """Return what tells `advance` of a part of the work, which takes it from the share `begin` to `end`."""
    return lambda share: advance(begin + (end - begin) * share)
