"""What a run writes down: the library's loggers, shown on a console and appended to a file while a command runs.

The library itself is silent: its modules log under their own names, below ``gnrecon``, and what becomes of that is for
the program that uses it to say, by Python's `logging`. The command line says it here, and undoes it at the end.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from gnrecon.runtime.errors import OutputError, UsageError

if TYPE_CHECKING:
    from rich.console import Console

FORM = "%(asctime)s %(levelname)s %(name)s: %(message)s"
TOLD = {"told": True}
"""Marks, as `extra`, what the caller's `Progress` is told as well, so that a console does not show it twice."""

_log = logging.getLogger(__name__)


class _OnConsole(logging.Handler):
    """Prints messages as they are, above a bar that may be there."""

    def __init__(self, console: Console) -> None:
        super().__init__(logging.INFO)
        self._console = console
        self.addFilter(lambda record: not getattr(record, "told", False))

    def emit(self, record: logging.LogRecord) -> None:
        """Print a message."""
        self._console.print(record.getMessage(), style="dim", highlight=False, markup=False, soft_wrap=True)


@contextmanager
def logged(console: Console | None, file: Path | None, others: Sequence[Path] = ()) -> Iterator[None]:
    """Show what the library logs while the block runs, and how the block failed, if it did.

    Parameters
    ----------
    console : prints choices, counts and the ends of stages; None for nothing
    file : everything is appended to, with the time; None for no file
    others : files that the block reads and writes, of which `file` must be none

    Raises
    ------
    UsageError
        When `file` is one of the others.
    OutputError
        When it cannot be written.
    """
    with ExitStack() as stack:
        if console is not None:
            stack.enter_context(_attached(_OnConsole(console), logging.INFO))
        if file is not None:
            stack.enter_context(_attached(_appending(file, others), logging.DEBUG))
        try:
            yield
        except BaseException as error:
            _log.error("%s: %s", type(error).__name__, error, extra=TOLD)
            _log.debug("Where it happened:", exc_info=True)
            raise


def _appending(file: Path, others: Sequence[Path]) -> logging.Handler:
    if any(file.resolve() == other.resolve() for other in others):
        raise UsageError(f"{file} is named twice; a log is appended to a file of its own.")
    try:
        handler = logging.FileHandler(file, encoding="utf-8")
    except OSError as error:
        raise OutputError(f"The log {file} cannot be written: {error.strerror or error}.") from error
    handler.setLevel(logging.DEBUG)
    handler.setFormatter(logging.Formatter(FORM))
    return handler


@contextmanager
def _attached(handler: logging.Handler, level: int) -> Iterator[None]:
    """Let the library's loggers reach a handler, and be as talkative as it needs, while the block runs."""
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
