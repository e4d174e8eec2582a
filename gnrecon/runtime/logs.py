"""Log output of the command line: to the console and to a file, while a command runs.

The library configures no logging. Its modules log under their own names, below ``gnrecon``, and the program that uses
it decides what happens to the records, by Python's `logging`. The command line does so here, and undoes it at the end.
"""

from __future__ import annotations

import logging
import os
import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from gnrecon.runtime.errors import OutputError, UsageError
from gnrecon.runtime.files import one_line, same_file

if TYPE_CHECKING:
    from rich.console import Console

ALREADY_SHOWN = {"already_shown": True}
"""Given as `extra` to a log call whose message the caller's `Progress` shows as well; the console then skips it."""

_log = logging.getLogger(__name__)


class _ConsoleHandler(logging.Handler):
    """Prints messages above the progress bar, if there is one."""

    def __init__(self, console: Console) -> None:
        super().__init__(logging.INFO)
        self._console = console
        self.addFilter(lambda record: not getattr(record, "already_shown", False))

    def emit(self, record: logging.LogRecord) -> None:
        """Print a message."""
        self._console.print(one_line(record.getMessage()), style="dim", highlight=False, markup=False, soft_wrap=True)


class _FileHandler(logging.FileHandler):
    """Appends to a file; where that fails, as on a full disk, one sentence says so and the rest is dropped."""

    _failed = False

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802 - logging's name
        """Say so once."""
        del record
        if not self._failed:
            self._failed = True
            print(f"The log {self.baseFilename} is not complete: {sys.exception()}.", file=sys.stderr)

    def close(self) -> None:
        """Close the file; what it does not take has been announced."""
        with suppress(OSError):
            super().close()


class _OneLineFormatter(logging.Formatter):
    """Writes a message in one line, whatever the names in it hold; tracebacks follow in lines of their own."""

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 - logging's name
        """Return the line."""
        return one_line(super().formatMessage(record))


@contextmanager
def logged(console: Console | None, file: Path | None, others: Sequence[Path] = ()) -> Iterator[None]:
    """Show what the library logs while the block runs, and the exception if the block fails.

    Parameters
    ----------
    console : shows records from level INFO; None for no output
    file : all records are appended here, with the time; None for no file
    others : files that the block reads and writes; `file` must not be one of them

    Raises
    ------
    UsageError
        When `file` is one of the others, or holds anything but a log.
    OutputError
        When it cannot be written.
    """
    with ExitStack() as stack:
        if console is not None:
            stack.enter_context(_attached(_ConsoleHandler(console), logging.INFO))
        if file is not None:
            stack.enter_context(_attached(_file_handler(file, others), logging.DEBUG))
        try:
            yield
        except BaseException as error:
            _log.error("%s: %s", type(error).__name__, error, extra=ALREADY_SHOWN)
            _log.debug("Where it happened:", exc_info=True)
            raise


@contextmanager
def unprinted_log(name: str) -> Iterator[None]:
    """Keep Python from printing a library's records to stderr; handlers that a program attached still get them.

    Python prints records of level WARNING and above where no handler is attached.

    Parameters
    ----------
    name : of the library's logger
    """
    logger, handler = logging.getLogger(name), logging.NullHandler()
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)


def require_log(file: Path, others: Sequence[Path]) -> None:
    """Refuse a file to which a log must not be appended.

    Raises
    ------
    UsageError
        When it is one of the others, or holds anything but a log.
    OutputError
        When it cannot be read.
    """
    if any(same_file(file, other) for other in others):
        raise UsageError(f"{file} is named twice; a log is appended to a file of its own.")
    try:
        if file.is_file() and not _is_log(file):
            raise UsageError(f"{file} exists and is no log of gnrecon; name another file for the log.")
    except OSError as error:
        raise OutputError(f"The log {file} cannot be written: {error.strerror or error}.") from error


def _file_handler(file: Path, others: Sequence[Path]) -> logging.Handler:
    require_log(file, others)
    try:
        if file.is_fifo():
            os.close(os.open(file, os.O_WRONLY | os.O_NONBLOCK))  # fails where nobody reads, instead of waiting for it
        handler = _FileHandler(file, encoding="utf-8", errors="backslashreplace")
    except OSError as error:
        raise OutputError(f"The log {file} cannot be written: {error.strerror or error}.") from error
    handler.setLevel(logging.DEBUG)
    handler.setFormatter(_OneLineFormatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    return handler


def _is_log(file: Path, *, most_bytes: int = 200) -> bool:
    """Whether a file is empty, or begins as a line of a log does: with a time, a level and the name of a logger."""
    with file.open("rb") as opened:
        start = opened.read(most_bytes)
    return not start or re.match(rb"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d,\d+ [A-Z]+ gnrecon", start) is not None


@contextmanager
def _attached(handler: logging.Handler, level: int) -> Iterator[None]:
    """Attach a handler to the library's logger, and lower its level as needed, while the block runs."""
    logger = logging.getLogger("gnrecon")
    before = logger.level
    logger.addHandler(handler)
    logger.setLevel(min(level, before or level))
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(before)
        handler.close()
