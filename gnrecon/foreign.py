"""Code of other people that runs on files: whatever it raises on damaged ones becomes one sentence."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from gnrecon.errors import GnreconError

_log = logging.getLogger(__name__)
_LONGEST = 200


@contextmanager
def guarded(kind: type[GnreconError], sentence: Callable[[BaseException], str]) -> Iterator[None]:
    """Run a block of other people's code.

    Failures of gnrecon's own kinds, want of memory, what the system says of a file, and interrupts come through as they
    are.

    Parameters
    ----------
    kind : of the failure that the block's own ones become
    sentence : says what failed, given what was raised; see `told`

    Raises
    ------
    GnreconError
        Of the given kind, when the block fails in any other way.
    """
    try:
        yield
    except (GnreconError, MemoryError):
        raise
    except BaseException as error:
        if not _fails(error):
            raise
        said = sentence(error)
        _log.info("%s", said, exc_info=True)
        raise kind(said) from error


def told(error: BaseException) -> str:
    """Return what was raised in one line: its type, and the beginning of what it says."""
    said = " ".join(str(error).split())[:_LONGEST]
    return f"{type(error).__name__}{': ' if said else ''}{said}"


def _fails(error: BaseException) -> bool:
    """Whether this is the code's own failure."""
    if isinstance(error, OSError):
        return error.errno is None
    # What goes wrong inside of a library written in Rust is a `PanicException`, which is no `Exception`.
    return isinstance(error, Exception | SystemExit) or type(error).__name__ == "PanicException"
