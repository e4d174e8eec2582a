"""What a forked process does first, to stand alone: a session, streams and an end of its own.

Its standard input is empty and its words go to a log. It ends when its parent does (``prctl(PR_SET_PDEATHSIG)`` of
Linux), so that a batch that is killed leaves no process behind; and where memory runs out it is the one that the system
is to end first (``oom_score_adj``), rather than the batch.
"""

from __future__ import annotations

import contextlib
import ctypes
import faulthandler
import os
import signal
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

_PR_SET_PDEATHSIG = 1


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
