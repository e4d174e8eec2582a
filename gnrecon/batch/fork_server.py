"""Fork server: a process that imports all libraries once and forks a child for each scan.

Importing torch and open3d takes some seconds; a fork takes some milliseconds. Each child is a process in its own
session, so that a crash of one scan affects neither this process nor other scans.

Started as ``python -m gnrecon.batch.fork_server SOCKET MODULE``, it listens on a Unix socket. A client connects, sends
one line of JSON (``argument``, ``log``, ``environment``), and receives one line with the child's ``pid`` and, when the
child has ended, one with its ``status``: the exit code or the negative signal. A client that hangs up ends its child.
When standard input ends, because the parent of this process has gone, all children end, and so does this process.
"""

from __future__ import annotations

import contextlib
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

from gnrecon.runtime.interrupts import die_with_parent


class ForkServer:
    """The loop that accepts clients, forks children and reports how they end.

    Parameters
    ----------
    listener : socket that clients connect to
    work : name of a module with ``work(argument) -> exit code``, which is imported already
    """

    def __init__(self, listener: socket.socket, work: str) -> None:
        self._listener, self._work = listener, work
        self._clients: dict[int, socket.socket] = {}
        self._selector = selectors.DefaultSelector()
        # The system reports the end of a child by a signal, which Python turns into a byte in this pipe.
        self._ended, waker = socket.socketpair()
        waker.setblocking(False)
        self._waker = waker
        signal.signal(signal.SIGCHLD, _ignore_signal)
        signal.set_wakeup_fd(waker.fileno(), warn_on_full_buffer=False)
        for source in (listener, self._ended, sys.stdin):
            self._selector.register(source, selectors.EVENT_READ)

    def serve(self) -> None:
        """Serve until standard input ends."""
        while True:
            for key, _ in self._selector.select():
                if key.fileobj is sys.stdin:
                    self._kill_all()
                    return
                if key.fileobj is self._listener:
                    self._accept()
                elif key.fileobj is self._ended:
                    self._ended.recv(4096)
                    self._reap()
                elif key.data in self._clients:
                    self._abandon(key.data)

    def _accept(self, *, request_timeout_seconds: float = 10.0) -> None:
        """Read one request and fork a child for it; a client that sends nothing in time is dropped."""
        client, _ = self._listener.accept()
        client.settimeout(request_timeout_seconds)
        try:
            request = json.loads(client.makefile("r", encoding="utf-8").readline())
        except (OSError, ValueError):  # the client left before its request was complete
            client.close()
            return
        sys.stdout.flush()
        parent, pid = os.getpid(), os.fork()
        if pid == 0:
            self._run_child(request, client, parent)
        self._clients[pid] = client
        self._selector.register(client, selectors.EVENT_READ, data=pid)
        self._send(pid, {"pid": pid})

    def _run_child(self, request: dict[str, Any], client: socket.socket, parent: int) -> NoReturn:
        code = 1
        try:
            signal.set_wakeup_fd(-1)
            for one in (client, self._listener, self._ended, self._waker, *self._clients.values()):
                one.close()
            self._selector.close()
            detach_child(request["log"], request["environment"], parent)
            code = int(import_module(self._work).work(request["argument"]))
        finally:
            # os._exit skips the exit handlers and the unwritten buffers that were copied from the parent.
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
                self._send(pid, {"status": os.waitstatus_to_exitcode(status)})
                self._forget(pid)

    def _abandon(self, pid: int) -> None:
        """Kill a child whose client has gone; it is reaped with the others."""
        self._forget(pid)
        _kill_group(pid)

    def _kill_all(self) -> None:
        for pid in list(self._clients):
            self._abandon(pid)

    def _send(self, pid: int, message: dict[str, int]) -> None:
        with contextlib.suppress(OSError):
            self._clients[pid].sendall(json.dumps(message).encode() + b"\n")

    def _forget(self, pid: int) -> None:
        client = self._clients.pop(pid)
        self._selector.unregister(client)
        client.close()


def _ignore_signal(number: int, frame: FrameType | None) -> None:
    """Do nothing. Without a Python handler, no byte is written to the wake-up pipe."""
    del number, frame


def _kill_group(pid: int) -> None:
    """Kill a child and the processes that it has started."""
    for kill in (os.killpg, os.kill):  # the group may not exist yet
        with contextlib.suppress(ProcessLookupError):
            kill(pid, signal.SIGKILL)


# A forked child first gets a session, streams and a lifetime of its own. Its standard input is empty and its output
# goes to a log. It ends when its parent does (``prctl(PR_SET_PDEATHSIG)`` of Linux), so that a batch that is killed
# leaves no process behind. Where memory runs out, the system kills it (``oom_score_adj``) before the batch itself.


def detach_child(log: str, environment: Mapping[str, str], parent: int) -> None:
    """Separate the calling, freshly forked process from its parent.

    Parameters
    ----------
    log : file that receives stdout and stderr; an older one is replaced
    environment : variables to set
    parent : process whose end also ends this one
    """
    # A session of its own, so that the whole process group can be killed.
    os.setsid()
    die_with_parent(parent)
    for number in (signal.SIGCHLD, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    _redirect(os.open(os.devnull, os.O_RDONLY), 0)
    output = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666)
    os.dup2(output, 1)
    _redirect(output, 2)
    faulthandler.enable(file=sys.stderr)  # a crash in native code then logs the Python stack
    os.environ.update(environment)
    tempfile.tempdir = None  # so that TMPDIR is read again
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("1000", encoding="ascii")


def _redirect(descriptor: int, target: int) -> None:
    os.dup2(descriptor, target)
    os.close(descriptor)


def main(arguments: list[str]) -> NoReturn:
    """Listen on the socket given by the first argument, for work of the module given by the second."""
    path, work = arguments
    # The batch handles interrupts; this process ends with its standard input.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    module = import_module(work)
    if hasattr(module, "prepare"):
        module.prepare()
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(path)
        listener.listen(64)
        print("ready", flush=True)
        ForkServer(listener, work).serve()
    # Skips the exit handlers of the libraries, which are slow.
    os._exit(0)


if __name__ == "__main__":
    main(sys.argv[1:])
