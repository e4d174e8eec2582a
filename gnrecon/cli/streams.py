"""Standard streams that never end a run: what a full device or a closed pipe does not take is dropped.

A mesh that was written is a success, whatever becomes of the sentence about it. At the end of a command, results that
standard output has not taken are a failure, unless the program that reads them has closed the pipe, as ``head`` does.
"""

from __future__ import annotations

import errno
import io
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TextIO

from gnrecon.runtime.errors import ExitCode


class LenientStream:
    """A text stream whose first failure is kept in `failure`; what follows is dropped. The rest is the stream's own."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self.failure: OSError | None = None

    def write(self, text: str) -> int:
        """Write text, or drop it after a failure."""
        if self.failure is None:
            try:
                return self._stream.write(text)
            except OSError as error:
                self._fail(error)
        return len(text)

    def flush(self) -> None:
        """Flush the stream, unless it has failed."""
        if self.failure is None:
            try:
                self._stream.flush()
            except OSError as error:
                self._fail(error)

    def _fail(self, error: OSError) -> None:
        self.failure = error
        with suppress(OSError, ValueError):
            # Python flushes what is left when it exits; the null device takes it.
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, self._stream.fileno())
            os.close(null)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


class Streams:
    """The lenient standard streams of a command."""

    def __init__(self, output: LenientStream, errors: LenientStream) -> None:
        self._output, self._errors = output, errors

    def exit_code(self, code: int) -> int:
        """Flush both, and return the command's exit code, or that of an unwritten output where results were lost."""
        self._output.flush()
        failure = self._output.failure
        if failure is not None and failure.errno != errno.EPIPE and code == ExitCode.OK:
            print(f"gnrecon: Standard output could not be written: {failure.strerror}.", file=self._errors)
            code = ExitCode.OUTPUT
        self._errors.flush()
        return int(code)


@contextmanager
def lenient_streams() -> Iterator[Streams]:
    """Make the standard streams lenient while the block runs, and open the null device for those that were closed."""
    _open_missing()
    before = sys.stdout, sys.stderr
    if isinstance(before[0], io.TextIOWrapper):
        # Names of files may hold bytes that are not UTF-8; Python escapes them on standard error alone.
        before[0].reconfigure(errors="backslashreplace")
    with Path(os.devnull).open("w", encoding="utf-8") as null:
        # Python has None for a stream that was closed.
        output, errors = LenientStream(before[0] or null), LenientStream(before[1] or null)
        sys.stdout, sys.stderr = output, errors
        try:
            yield Streams(output, errors)
        finally:
            sys.stdout, sys.stderr = before


def _open_missing(*, standard_streams: int = 3) -> None:
    """Open the null device under the numbers of closed streams, so that no mesh is opened under one of them."""
    while (number := os.open(os.devnull, os.O_RDWR)) < standard_streams:
        pass
    os.close(number)
