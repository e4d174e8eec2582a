"""Errors that end a run, each with the exit code of the command line.

Every message is one sentence for the user: it names what is wrong and what was expected.
"""

from __future__ import annotations

import enum
import errno
from collections.abc import Iterable
from difflib import get_close_matches


class ExitCode(enum.IntEnum):
    """Exit codes of the command line."""

    OK = 0
    UNFORESEEN = 1
    USAGE = 2
    INPUT = 3
    FIT = 4
    MESH = 5
    OUTPUT = 6
    MEMORY = 7
    BATCH = 8
    INTERRUPTED = 130


class GnreconError(Exception):
    """Base of all errors that gnrecon raises on purpose; ``exit_code`` is what the command line returns."""

    exit_code: ExitCode = ExitCode.USAGE


class UsageError(GnreconError, ValueError):
    """An option or argument is unknown, out of range, or contradicts another."""

    exit_code = ExitCode.USAGE


class InputError(GnreconError, ValueError):
    """A file or array cannot be read, or its contents cannot be reconstructed."""

    exit_code = ExitCode.INPUT


class FitError(GnreconError, RuntimeError):
    """The field could not be fitted (non-finite values, a singular system)."""

    exit_code = ExitCode.FIT


class MeshError(GnreconError, RuntimeError):
    """The mesh is empty, open, not manifold or not oriented, and could not be repaired."""

    exit_code = ExitCode.MESH


class OutputError(GnreconError, OSError):
    """A result could not be written."""

    exit_code = ExitCode.OUTPUT


class Cancelled(GnreconError):  # noqa: N818 - not an error
    """Raised by the caller's own `Progress` to cancel a run, which then writes and returns nothing."""

    exit_code = ExitCode.INTERRUPTED

    def __init__(self, sentence: str = "Cancelled; nothing was written.") -> None:
        super().__init__(sentence)


class MemoryLimitError(GnreconError, MemoryError):
    """The work needs more memory than is available."""

    exit_code = ExitCode.MEMORY


def suggestion(word: str, known: Iterable[str], *, kind: str = "options") -> str:
    """Return the end of a sentence on an unknown name: the likeliest right one, or else all that are known.

    Parameters
    ----------
    word : what was written
    known : the names, as they are written
    kind : what they are, in the plural; empty to name the likeliest alone
    """
    names = list(known)
    if close := get_close_matches(word.lower(), names, 1):
        return f"; perhaps you mean {close[0]!r}"
    return f"; the {kind} are {', '.join(names)}" if kind else ""


def _lacks_memory(error: BaseException) -> bool:
    """Whether memory was missing; for libraries and threads, the system says so by other errors, and their text."""
    words = ("failed to map segment", "annot allocate memory", "can't start new thread")
    return isinstance(error, MemoryError) or (
        isinstance(error, ImportError | OSError | RuntimeError) and any(word in str(error) for word in words)
    )


def failure(error: BaseException) -> tuple[str, ExitCode]:
    """Return the message and the exit code for the exception that ended a run."""
    if isinstance(error, GnreconError):
        return str(error), error.exit_code
    if isinstance(error, KeyboardInterrupt):
        return "Interrupted; nothing was written.", ExitCode.INTERRUPTED
    if _lacks_memory(error):
        return f"There is not enough memory. {error}".strip(), ExitCode.MEMORY
    if isinstance(error, OSError) and error.errno == errno.ENAMETOOLONG:
        return f"{error.filename}: {error.strerror}.", ExitCode.USAGE
    # A bug in gnrecon: the user still gets one sentence, and a way to report it.
    name = type(error).__name__
    return f"Unforeseen {name}: {error} Please report it with the output of --debug.", ExitCode.UNFORESEEN
