"""Starting child processes for scans, through fork servers that start on demand.

There is one fork server for each number of threads: the numerical libraries read that number when they are loaded, and
all children forked from one process share it.
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


class ForkServerError(GnreconError, RuntimeError):
    """A fork server could not be started, or has ended."""

    exit_code = ExitCode.UNFORESEEN


class ForkedChild:
    """A running child process; leaving its block kills it if it is still running."""

    def __init__(self, connection: socket.socket) -> None:
        self._connection, self._buffer = connection, b""
        answer = self._receive()
        if answer is None:
            connection.close()
            raise ForkServerError("The process that starts a process for each scan has ended.")
        self.pid = int(answer["pid"])

    def wait(self, seconds: float) -> int | None:
        """Return the exit code, or the negative signal, if the child ends within so many seconds.

        Raises
        ------
        ForkServerError
            When the fork server has ended, and the child with it.
        """
        if not select.select([self._connection], [], [], seconds)[0]:
            return None
        answer = self._receive()
        if answer is None:
            raise ForkServerError("The process that starts a process for each scan has ended, with all of them.")
        return int(answer["status"])

    def _receive(self) -> dict[str, Any] | None:
        while b"\n" not in self._buffer:
            try:
                received = self._connection.recv(4096)
            except ConnectionError:
                return None
            if not received:
                return None
            self._buffer += received
        line, _, self._buffer = self._buffer.partition(b"\n")
        answer: dict[str, Any] = json.loads(line)
        return answer

    def __enter__(self) -> ForkedChild:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._connection.close()


class ForkServerClient:
    """Starts a fork server when it is first needed, and again after it has ended.

    Parameters
    ----------
    threads : of the numerical libraries
    work : module whose function ``work`` the children run
    """

    def __init__(self, threads: int, work: str) -> None:
        self._threads, self._work = threads, work
        self._lock = threading.Lock()
        self._process: subprocess.Popen[str] | None = None
        self._folder: Path | None = None
        self._ready = False

    def start_child(self, argument: Mapping[str, Any], log: Path, environment: Mapping[str, str]) -> ForkedChild:
        """Start a child that does the work with an argument.

        Raises
        ------
        ForkServerError
            When no fork server can be started, or it ends at once.
        """
        request = {"argument": dict(argument), "log": str(log), "environment": dict(environment)}
        line = json.dumps(request).encode() + b"\n"
        with self._lock:
            if self._process is None:
                self._start()
            try:
                return self._send(line)
            except ForkServerError:  # it was killed from outside
                self.close()
                self._start()
                return self._send(line)

    def _send(self, line: bytes) -> ForkedChild:
        connection = socket.socket(socket.AF_UNIX)
        try:
            connection.connect(str(self._address))
            connection.sendall(line)
        except OSError as error:
            connection.close()
            raise ForkServerError(
                f"The process that starts a process for each scan has ended ({error.strerror})."
            ) from error
        return ForkedChild(connection)

    @property
    def _address(self) -> Path:
        assert self._folder is not None
        return self._folder / "socket"

    def _start(self) -> None:
        self._folder, self._ready = Path(tempfile.mkdtemp(prefix="gnrecon-")), False
        command = [sys.executable, "-m", "gnrecon.batch.fork_server", str(self._address), self._work]
        with (self._folder / "errors").open("w+", encoding="utf-8") as errors:
            # A session of its own: signals to the group of this process, as of a terminal that is closed, are this
            # process's to handle.
            process = subprocess.Popen(
                command,
                env=self._environment(),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
                start_new_session=True,
            )
            self._process = process
            assert process.stdout is not None
            self._ready = process.stdout.readline() == "ready\n"
            if not self._ready:
                errors.seek(0)
                lines = errors.read().strip().splitlines()
                self.close()
                process.stdout.close()
                raise ForkServerError(
                    f"No process could be started for the scans: {lines[-1] if lines else 'it ended at once'}."
                )

    def _environment(self) -> dict[str, str]:
        # The server must run this very copy of gnrecon, and find the work module where this process would.
        path = [str(Path(str(gnrecon.__file__)).parents[1]), *filter(None, sys.path)]
        threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), str(self._threads))
        # Passive: idle OpenMP threads of one scan sleep instead of spinning on cores that other scans use.
        return {"OMP_WAIT_POLICY": "PASSIVE", **os.environ, **threads, "PYTHONPATH": os.pathsep.join(path)}

    def close(self, *, exit_seconds: float = 10.0) -> None:
        """End the fork server and all of its children; it is killed where it has not ended after `exit_seconds`.

        Another thread may be starting one, and close it itself when that fails; one that is not ready is killed.
        """
        process, self._process = self._process, None
        if process is not None:
            assert process.stdin is not None
            assert process.stdout is not None
            with contextlib.suppress(OSError):
                process.stdin.close()
            try:
                process.wait(exit_seconds if self._ready else 0.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            if self._ready:  # else the other thread still reads from it
                process.stdout.close()
        folder, self._folder = self._folder, None
        if folder is not None:
            shutil.rmtree(folder, ignore_errors=True)


_servers: dict[tuple[int, str], ForkServerClient] = {}
_lock = threading.Lock()


def start_child(
    threads: int, argument: Mapping[str, Any], log: Path, environment: Mapping[str, str], work: str | None = None
) -> ForkedChild:
    """Start a child of this process's fork server for a number of threads.

    Parameters
    ----------
    threads : of the numerical libraries
    argument : of the work, plain values
    log : file for the child's output
    environment : variables to set in the child
    work : module with ``work(argument) -> exit code``; by default `gnrecon.batch.child_main`

    Raises
    ------
    ForkServerError
        When none can be started.
    """
    module = work or "gnrecon.batch.child_main"
    with _lock:
        server = _servers.setdefault((threads, module), ForkServerClient(threads, module))
    return server.start_child(argument, log, environment)


@atexit.register
def close_fork_servers() -> None:
    """End all fork servers of this process, and their children."""
    with _lock:
        for server in _servers.values():
            server.close()
        _servers.clear()
