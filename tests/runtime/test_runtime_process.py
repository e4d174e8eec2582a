"""What a process of the command line sets at its start, and how it ends."""

from __future__ import annotations

import os
import platform
import subprocess
import sys

import pytest


def run_python(program: str, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run a program without this process's variables for threads and heaps, and with the given ones."""
    settled = ("MALLOC_ARENA_MAX", "OMP_WAIT_POLICY")
    kept = {name: value for name, value in os.environ.items() if name not in settled}
    environment = {**kept, "PYTHONPATH": os.pathsep.join(filter(None, sys.path)), **variables}
    return subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, timeout=60)


def test_variables_of_the_user_stay() -> None:
    environment = {"OMP_WAIT_POLICY": "ACTIVE", "MALLOC_ARENA_MAX": "7"}
    program = f"from gnrecon.runtime.process import settle_process; v={environment}; settle_process(v); print(v)"
    assert run_python(program).stdout == f"{environment}\n"


def test_child_processes_inherit_what_is_set() -> None:
    program = (
        "import os, subprocess; from gnrecon.runtime.process import settle_process; settle_process(os.environ); "
        "subprocess.run(['printenv', 'OMP_WAIT_POLICY', 'MALLOC_ARENA_MAX'])"
    )
    assert run_python(program).stdout == "PASSIVE\n2\n"


HEAPS = """
import ctypes, os, threading
from gnrecon.runtime.process import settle_process
libc = ctypes.CDLL(None)
libc.malloc.restype = ctypes.c_void_p
if {settled}:
    settle_process(os.environ)
gate = threading.Barrier(8)
def work():
    libc.malloc(100_000)  # more than a thread keeps for itself, and less than the system gives
    gate.wait()
threads = [threading.Thread(target=work) for _ in range(8)]
[thread.start() for thread in threads]
[thread.join() for thread in threads]
libc.fdopen.restype = ctypes.c_void_p
stream = ctypes.c_void_p(libc.fdopen(1, b"w"))
libc.malloc_info(0, stream)
libc.fflush(stream)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc's malloc has heaps that can be counted")
def test_threads_share_two_heaps() -> None:
    def heaps(settled: bool, **variables: str) -> int:
        return run_python(HEAPS.format(settled=settled), **variables).stdout.count("<heap nr=")

    assert heaps(settled=False) > 2
    assert heaps(settled=True) == 2
    assert heaps(settled=True, MALLOC_ARENA_MAX="3") == 3


@pytest.mark.parametrize("code", [0, 5])
def test_the_end_runs_what_is_registered_and_flushes(code: int) -> None:
    program = (
        "import atexit, sys; from gnrecon.runtime.process import end_process; "
        "atexit.register(print, 'registered', end=''); print('output', end=' '); sys.stderr.write('error'); "
        f"end_process({code})"
    )
    ended = run_python(program)
    assert (ended.returncode, ended.stdout, ended.stderr) == (code, "output registered", "error")


def test_the_end_waits_for_threads() -> None:
    program = (
        "import threading, time; from gnrecon.runtime.process import end_process; "
        "threading.Thread(target=lambda: (time.sleep(0.3), print('done'))).start(); end_process(3)"
    )
    ended = run_python(program)
    assert (ended.returncode, ended.stdout) == (3, "done\n")


def test_the_end_leaves_a_profiler_its_results() -> None:
    program = (
        "import sys; from gnrecon.runtime.process import end_process\n"
        "sys.setprofile(lambda *_: None)\n"
        "try:\n    end_process(4)\nexcept SystemExit as end:\n    print(end.code)"
    )
    assert run_python(program).stdout == "4\n"


def test_the_end_survives_closed_streams() -> None:
    program = "import sys; from gnrecon.runtime.process import end_process; sys.stdout.close(); end_process(6)"
    ended = run_python(program)
    assert (ended.returncode, ended.stderr) == (6, "")
    missing = "import sys; from gnrecon.runtime.process import end_process; sys.stderr = None; end_process(7)"
    assert run_python(missing).returncode == 7
