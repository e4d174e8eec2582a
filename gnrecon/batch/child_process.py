"""Child processes for scans, by way of a `forker` that is started when the first one is wanted.

There is one forker for each number of threads, because the numerical libraries read that number when they are loaded;
all threads of a process share them.
"""

from __future__ import annotations

import atexit
import contextlib
import json
import os
import select
import shutil
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

import gnrecon
from gnrecon.runtime.errors import ExitCode, GnreconError

WORK = "gnrecon.batch.child"
"""Module whose function ``work`` a child runs."""

THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class ForkerError(GnreconError, RuntimeError):
    """The process that forks others could not be started, or has ended."""

    exit_code = ExitCode.UNFORESEEN


class Child:
    """A running child; leaving its block ends it, if it has not ended by itself."""

    def __init__(self, connection: socket.socket) -> None:
        self._connection, self._rest = connection, b""
        answer = self._receive()
        if answer is None:
            connection.close()
            raise ForkerError("The process that starts the scans' own ones has ended.")
        self.pid = int(answer["pid"])

    def wait(self, seconds: float) -> int | None:
        """Return the exit code, or the negative signal, if the child ends within so many seconds.

        Raises
        ------
        ForkerError
            When the forker has ended, and the child with it.
        """
        if not select.select([self._connection], [], [], seconds)[0]:
            return None
        answer = self._receive()
        if answer is None:
            raise ForkerError("The process that starts the scans' own ones has ended, and its children with it.")
        return int(answer["status"])

    def _receive(self) -> dict[str, Any] | None:
        while b"\n" not in self._rest:
            try:
                more = self._connection.recv(4096)
            except ConnectionError:
                return None
            if not more:
                return None
            self._rest += more
        line, _, self._rest = self._rest.partition(b"\n")
        found: dict[str, Any] = json.loads(line)
        return found

    def __enter__(self) -> Child:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._connection.close()


class Nursery:
    """A forker, started when it is needed and again when it has ended.

    Parameters
    ----------
    threads : of the numerical libraries
    work : module of the work
    """

    def __init__(self, threads: int, work: str) -> None:
        self._threads, self._work = threads, work
        self._lock = threading.Lock()
        self._process: subprocess.Popen[str] | None = None
        self._folder: Path | None = None

    def child(self, argument: Mapping[str, Any], log: Path, environment: Mapping[str, str]) -> Child:
        """Start a child that does the work with an argument.

        Raises
        ------
        ForkerError
            When no forker can be started, or it ends at once.
        """
        request = {"argument": dict(argument), "log": str(log), "environment": dict(environment)}
        line = json.dumps(request).encode() + b"\n"
        with self._lock:
            if self._process is None:
                self._start()
            try:
                return self._ask(line)
            except ForkerError:  # it was ended from outside
                self.close()
                self._start()
                return self._ask(line)

    def _ask(self, line: bytes) -> Child:
        connection = socket.socket(socket.AF_UNIX)
        try:
            connection.connect(str(self._address))
            connection.sendall(line)
        except OSError as error:
            connection.close()
            raise ForkerError(f"The process that starts the scans' own ones has ended ({error.strerror}).") from error
        return Child(connection)

    @property
    def _address(self) -> Path:
        assert self._folder is not None
        return self._folder / "forker"

    def _start(self) -> None:
        self._folder = Path(tempfile.mkdtemp(prefix="gnrecon-"))
        command = [sys.executable, "-m", "gnrecon.batch.fork_server", str(self._address), self._work]
        with (self._folder / "words").open("w", encoding="utf-8") as words:
            self._process = subprocess.Popen(
                command, env=self._environment(), stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=words, text=True
            )
        assert self._process.stdout is not None
        if self._process.stdout.readline() != "ready\n":
            said = (self._folder / "words").read_text(encoding="utf-8").strip().splitlines()
            self.close()
            raise ForkerError(f"No process could be started for the scans: {said[-1] if said else 'it ended at once'}.")

    def _environment(self) -> dict[str, str]:
        # The forker is to be of this very gnrecon, and to find the work wherever this process would.
        here = [str(Path(str(gnrecon.__file__)).parents[1]), *filter(None, sys.path)]
        threads = dict.fromkeys(THREAD_VARIABLES, str(self._threads))
        return {"OMP_WAIT_POLICY": "PASSIVE", **os.environ, **threads, "PYTHONPATH": os.pathsep.join(here)}

    def close(self) -> None:
        """End the forker and all of its children."""
        if self._process is not None:
            assert self._process.stdin is not None
            assert self._process.stdout is not None
            with contextlib.suppress(OSError):
                self._process.stdin.close()
            try:
                self._process.wait(10.0)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
            self._process.stdout.close()
            self._process = None
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)
            self._folder = None


_running: dict[tuple[int, str], Nursery] = {}
_lock = threading.Lock()


def start_child(
    threads: int, argument: Mapping[str, Any], log: Path, environment: Mapping[str, str], work: str = WORK
) -> Child:
    """Start a child of this process's forker for a number of threads.

    Raises
    ------
    ForkerError
        When none can be started.
    """
    with _lock:
        forker = _running.setdefault((threads, work), Nursery(threads, work))
    return forker.child(argument, log, environment)


@atexit.register
def close_forkers() -> None:
    """End all forkers of this process, and their children."""
    with _lock:
        for forker in _running.values():
            forker.close()
        _running.clear()
