"""A process that has imported all libraries once, and forks a child for each scan that is asked for.

Importing torch and open3d takes some seconds, a fork some milliseconds. The child is a process in its own session: what
kills it, or what it does to its memory, touches neither this process nor other scans.

Started as ``python -m gnrecon.batch.fork_server SOCKET MODULE``, it listens on a Unix socket. A client connects, sends
one line of JSON (``argument``, ``log``, ``environment``), and receives one line with the child's ``pid`` and, when it
has ended, one with its ``status``, the exit code or the negative signal. A client that hangs up ends its child. When
standard input ends, because the one who started this process is gone, all children end, and so does this process.
"""

from __future__ import annotations

import contextlib
import ctypes
import faulthandler
import json
import os
import selectors
import signal
import socket
import sys
import tempfile
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn


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


_PR_SET_PDEATHSIG = 1


# What a forked process does first, to stand alone: a session, streams and an end of its own.
#
# Its standard input is empty and its words go to a log. It ends when its parent does (``prctl(PR_SET_PDEATHSIG)`` of
# Linux), so that a batch that is killed leaves no process behind; and where memory runs out it is the one that the
# system is to end first (``oom_score_adj``), rather than the batch.


def become_child(log: str, environment: Mapping[str, str], parent: int) -> None:
    """Take the calling, freshly forked process apart from its parent.

    Parameters
    ----------
    log : file that receives what is said on stdout and stderr; an older one is replaced
    environment : variables to set
    parent : process whose end is to be this one's, too
    """
    os.setsid()
    end_with(parent)
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    _redirect(os.open(os.devnull, os.O_RDONLY), 0)
    words = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666)
    os.dup2(words, 1)
    _redirect(words, 2)
    faulthandler.enable(file=sys.stderr)  # the log of a crash in native code shows where Python was
    os.environ.update(environment)
    tempfile.tempdir = None  # so that TMPDIR is looked up again
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("1000", encoding="ascii")


def end_with(parent: int) -> None:
    """Let the system kill this process when its parent ends; where it has ended already, end now."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)


def _redirect(descriptor: int, target: int) -> None:
    os.dup2(descriptor, target)
    os.close(descriptor)


if __name__ == "__main__":
    main(sys.argv[1:])
