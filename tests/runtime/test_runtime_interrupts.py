"""Signals end a program once, politely: not in native code, not twice, and not when its results are complete."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from gnrecon.runtime.interrupts import ignore_interrupts, polite_ends, postponed_interrupts
from gnrecon.runtime.quiet_imports import import_uninterrupted


def send(number: signal.Signals = signal.SIGTERM) -> None:
    os.kill(os.getpid(), number)


@pytest.fixture(autouse=True)
def handler() -> Iterator[object]:
    before = signal.getsignal(signal.SIGTERM)
    yield before
    signal.signal(signal.SIGTERM, before)


def test_signals_in_quick_succession_are_one() -> None:
    cleaned = False
    with polite_ends():
        with pytest.raises(KeyboardInterrupt):
            send(signal.SIGHUP)
        for number in (signal.SIGTERM, signal.SIGINT):
            send(number)
        cleaned = True
    assert cleaned


def test_a_later_signal_is_another(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 100.0
    monkeypatch.setattr("time.monotonic", lambda: now)
    with polite_ends():
        for _ in range(2):
            with pytest.raises(KeyboardInterrupt):
                send()
            now += 1.0


def test_complete_results_are_not_interrupted(handler: object) -> None:
    with polite_ends():
        ignore_interrupts()
        send()
    assert signal.getsignal(signal.SIGTERM) is handler
    with polite_ends(), pytest.raises(KeyboardInterrupt):
        send()


@pytest.mark.parametrize("threaded", [False, True])
def test_native_code_is_not_interrupted(threaded: bool) -> None:
    ended = False

    def native() -> None:
        nonlocal ended
        with postponed_interrupts():
            send()
            ended = True

    def run() -> None:
        if not threaded:
            native()
        thread = threading.Thread(target=native)
        thread.start()
        thread.join()
        pytest.fail("the interrupt was lost")

    with polite_ends(), pytest.raises(KeyboardInterrupt):
        run()
    assert ended


def test_a_library_is_imported_before_the_interrupt(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "interrupted_library.py").write_text(
        "import os, signal\nos.kill(os.getpid(), signal.SIGTERM)\nready = True\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    with polite_ends(), pytest.raises(KeyboardInterrupt):
        import_uninterrupted("interrupted_library")
    assert sys.modules.pop("interrupted_library").ready


def test_the_process_ends_by_its_own_exit_code(tmp_path: Path) -> None:
    """Also after an interrupt within text that Python runs, and where more signals come meanwhile."""
    (tmp_path / "ending.py").write_text(
        "import os, signal, sys\n"
        "from gnrecon.runtime.interrupts import polite_ends\n"
        "with polite_ends(process_ends=True):\n"
        "    try:\n"
        "        exec('os.kill(os.getpid(), signal.SIGTERM)')\n"
        "    except KeyboardInterrupt:\n"
        "        print('interrupted')\n"
        "os.kill(os.getpid(), signal.SIGHUP)\n"
        "sys.exit(130)\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[2])}
    done = subprocess.run(
        [sys.executable, "-m", "ending"], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=60
    )
    assert (done.returncode, done.stdout, done.stderr) == (130, "interrupted\n", "")
