"""A process that has imported all libraries once, and forks a child for each scan that is asked for.

Importing torch and open3d takes some seconds, a fork some milliseconds. The child is a process in its own session: what
kills it, or what it does to its memory, touches neither this process nor other scans.

It is started as ``python -m gnrecon.batch.forker SOCKET MODULE`` and listens on a Unix socket. A client connects, sends
one line of JSON (``argument``, ``log``, ``environment``), and receives one line with the child's ``pid`` and, when it
has ended, one with its ``status``, the exit code or the negative signal. A client that hangs up ends its child. When
standard input ends, because the one who started this process is gone, all children end, and so does this process.
"""

from __future__ import annotations

import contextlib
import json
import os
import selectors
import signal
import socket
import sys
from importlib import import_module
from types import FrameType
from typing import Any, NoReturn

from gnrecon.batch.fledgling import become_child


class Forker:
    """The loop that accepts clients, forks children and tells their ends.

    Parameters
    ----------
    listener : socket that clients connect to
    work : name of a module with ``work(argument) -> exit code``, which is imported already
    """

    def __init__(self, listener: socket.socket, work: str) -> None:
        self._listener, self._work = listener, work
        self._clients: dict[int, socket.socket] = {}
        self._selector = selectors.DefaultSelector()
        # The system says that a child has ended by a signal, and Python by a byte in this pipe.
        self._ended, waker = socket.socketpair()
        waker.setblocking(False)
        self._waker = waker
        signal.signal(signal.SIGCHLD, _wake)
        signal.set_wakeup_fd(waker.fileno(), warn_on_full_buffer=False)
        for source in (listener, self._ended, sys.stdin):
            self._selector.register(source, selectors.EVENT_READ)

    def serve(self) -> None:
        """Serve until standard input ends."""
        while True:
            for key, _ in self._selector.select():
                if key.fileobj is sys.stdin:
                    self._end_all()
                    return
                if key.fileobj is self._listener:
                    self._accept()
                elif key.fileobj is self._ended:
                    self._ended.recv(4096)
                    self._reap()
                elif key.data in self._clients:
                    self._hang_up(key.data)

    def _accept(self) -> None:
        client, _ = self._listener.accept()
        client.settimeout(10.0)
        try:
            request = json.loads(client.makefile("r", encoding="utf-8").readline())
        except (OSError, ValueError):  # one that was gone before it had said anything
            client.close()
            return
        sys.stdout.flush()
        parent, pid = os.getpid(), os.fork()
        if pid == 0:
            self._be_child(request, client, parent)
        self._clients[pid] = client
        self._selector.register(client, selectors.EVENT_READ, data=pid)
        self._tell(pid, {"pid": pid})

    def _be_child(self, request: dict[str, Any], client: socket.socket, parent: int) -> NoReturn:
        code = 1
        try:
            signal.set_wakeup_fd(-1)
            for one in (client, self._listener, self._ended, self._waker, *self._clients.values()):
                one.close()
            self._selector.close()
            become_child(request["log"], request["environment"], parent)
            code = int(import_module(self._work).work(request["argument"]))
        finally:
            # Neither the exit handlers nor the buffers of the process that this is a copy of.
            with contextlib.suppress(OSError, ValueError):
                sys.stdout.flush()
                sys.stderr.flush()
            os._exit(code)

    def _reap(self) -> None:
        while True:
            try:
                pid, status = os.waitpid(-1, os.WNOHANG)
            except ChildProcessError:
                return
            if pid == 0:
                return
            if pid in self._clients:
                self._tell(pid, {"status": os.waitstatus_to_exitcode(status)})
                self._forget(pid)

    def _hang_up(self, pid: int) -> None:
        """End a child that nobody waits for any more; it is reaped with the others."""
        self._forget(pid)
        _end(pid)

    def _end_all(self) -> None:
        for pid in list(self._clients):
            self._hang_up(pid)

    def _tell(self, pid: int, message: dict[str, int]) -> None:
        with contextlib.suppress(OSError):
            self._clients[pid].sendall(json.dumps(message).encode() + b"\n")

    def _forget(self, pid: int) -> None:
        client = self._clients.pop(pid)
        self._selector.unregister(client)
        client.close()


def _wake(number: int, frame: FrameType | None) -> None:
    """Nothing is to be done; but without a handler, Python would write no byte."""
    del number, frame


def _end(pid: int) -> None:
    """Kill a child and what it has started."""
    for kill in (os.killpg, os.kill):  # the group may not be there yet
        with contextlib.suppress(ProcessLookupError):
            kill(pid, signal.SIGKILL)


def main(words: list[str]) -> NoReturn:
    """Listen on the socket that the first word names, for work that the second one names."""
    path, work = words
    module = import_module(work)
    if hasattr(module, "prepare"):
        module.prepare()
    # An interrupt of the terminal is for the batch to deal with.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(path)
        listener.listen(64)
        print("ready", flush=True)
        Forker(listener, work).serve()
    # Nothing is left to be done, and the libraries take their time to go.
    os._exit(0)


if __name__ == "__main__":
    main(sys.argv[1:])
