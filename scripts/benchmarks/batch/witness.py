"""Somebody who watches a batch from outside, and lets two of its scans come to grief: one is killed, one stopped."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import threading
from collections import defaultdict
from pathlib import Path
from types import TracebackType

from gnrecon.batch.job import progress_file, records_folder, running_folder

ACCIDENTS = {"killed": signal.SIGSEGV, "hangs": signal.SIGSTOP}
"""Names of scans, and the signals that their processes are sent."""


class Witness:
    """Watches while its block runs.

    Parameters
    ----------
    output : the batch's output folder
    """

    def __init__(self, output: Path) -> None:
        self._output, self._over = output, threading.Event()
        self._writings: dict[str, set[int]] = defaultdict(set)
        self._thread = threading.Thread(target=self._watch)

    def finished(self) -> list[str]:
        """Return the names of the scans that have been finished, sorted."""
        return sorted(self._writings)

    def twice(self) -> list[str]:
        """Return the names of the scans that have been finished more than once."""
        return sorted(name for name, times in self._writings.items() if len(times) > 1)

    def _watch(self) -> None:
        while not self._over.wait(0.05):
            self.look()
            for name, number in ACCIDENTS.items():
                for pid in running(self._output, name):
                    with contextlib.suppress(ProcessLookupError):
                        os.kill(pid, number)

    def look(self) -> None:
        """Note which records are there, and when they were written."""
        for record in records_folder(self._output).glob("[a-z]*.json"):
            with contextlib.suppress(FileNotFoundError):
                self._writings[record.stem].add(record.stat().st_mtime_ns)

    def __enter__(self) -> Witness:
        self.look()
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._over.set()
        self._thread.join()
        self.look()


def running(output: Path, name: str) -> list[int]:
    """Return the processes that work at a scan now."""
    found = []
    for progress in map(progress_file, running_folder(output).glob(f"{name}-*")):
        with contextlib.suppress(OSError, ValueError, KeyError):
            found.append(int(json.loads(progress.read_text(encoding="utf-8"))["pid"]))
    return found
