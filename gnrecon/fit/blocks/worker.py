"""``python -m gnrecon.fit.blocks.worker IN,OUT ...``: a process for each pair of file descriptors, which solves blocks.

Libraries are imported once: then the first process forks the others. Each reads lines of JSON, ``[folder, block]``, and
answers each by a line: ``done``, or the error. It ends when its input does, and so with the process that started it,
however that ends. The first one ends all when it is asked to terminate, and ends as another one did that died.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import sys
from collections.abc import Sequence
from types import FrameType
from typing import NoReturn

from gnrecon.fit.blocks.block import solve_block
from gnrecon.runtime.interrupts import die_with_parent
from gnrecon.runtime.parallel import fixed_sums

DONE = "done"
"""Answer of a worker that has solved a block."""


class _Forked:
    """The processes that the first one has forked."""

    def __init__(self) -> None:
        self._running = set[int]()

    def is_forked(self) -> bool:
        """Fork a process, and return whether it is this one."""
        parent = os.getpid()
        if pid := os.fork():
            self._running.add(pid)
            return False
        die_with_parent(parent)
        return True

    def watch(self) -> None:
        """End with the others, and as one of them that died."""
        signal.signal(signal.SIGTERM, self._terminate)
        signal.signal(signal.SIGCHLD, self._end_as_another)
        self._end_as_another()  # one may have died before

    def _kill(self) -> None:
        """Kill those that run and reap them: where nothing reaps orphans, they would stay as zombies."""
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        for pid in list(self._running):
            with contextlib.suppress(ProcessLookupError, ChildProcessError):
                os.kill(pid, signal.SIGKILL)
                os.waitpid(pid, 0)

    def _terminate(self, number: int, frame: FrameType | None) -> NoReturn:
        del frame
        self._kill()
        os._exit(128 + number)

    def _end_as_another(self, number: int = signal.SIGCHLD, frame: FrameType | None = None) -> None:
        """End as a process did that failed; others have come to the end of their input."""
        del number, frame
        for pid in list(self._running):
            try:
                ended, status = os.waitpid(pid, os.WNOHANG)
            except ChildProcessError:  # reaped by the same handler, while it was interrupted here
                continue
            if not ended:
                continue
            self._running.discard(pid)
            if (code := os.waitstatus_to_exitcode(status)) == 0:
                continue
            self._kill()
            if code < 0:
                os.kill(os.getpid(), -code)
            os._exit(abs(code))


def main(pairs: Sequence[tuple[int, int]]) -> NoReturn:
    """Solve the requested blocks in this process, and in one more for each further pair of an input and an output."""
    # Ctrl-C reaches the whole process group: the parent decides what ends.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    forked = _Forked()
    own = next((pair for pair in pairs[1:] if forked.is_forked()), pairs[0])
    if own == pairs[0]:
        forked.watch()
    for pair in pairs:
        if pair != own:
            os.close(pair[0])
            os.close(pair[1])
    code = 1
    try:
        _solve_requested(*own)
        code = 0
    finally:
        # Skips what the libraries do at the end, which is slow.
        os._exit(code)


def _solve_requested(requests: int, answers: int) -> None:
    """Solve the requested blocks with one thread, so that processes do not compete for cores."""
    with (
        fixed_sums(1),
        os.fdopen(requests, encoding="utf-8") as lines,
        os.fdopen(answers, "w", encoding="utf-8") as output,
    ):
        for line in lines:
            try:
                solve_block(*json.loads(line))
                answer = DONE
            except Exception as error:  # sent to the parent, which raises it
                answer = f"{type(error).__name__}: {' '.join(str(error).split())}"
            print(answer, file=output, flush=True)


if __name__ == "__main__":
    main([(int(one), int(other)) for one, other in (pair.split(",") for pair in sys.argv[1:])])
