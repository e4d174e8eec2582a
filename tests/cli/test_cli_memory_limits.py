"""Limits of memory end a command by one sentence and the exit code for memory, also where native code meets them."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scan_files import torus

from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.io import write_cloud
from gnrecon.runtime.errors import ExitCode

PACKAGE = str(Path(__file__).resolve().parents[2])


def ended(words: list[str], addresses_kb: int | None = None) -> subprocess.CompletedProcess[str]:
    """Run Python with such words, under a limit of its addresses if one is given, as ``ulimit -v`` sets it."""

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        if addresses_kb is not None:
            resource.setrlimit(resource.RLIMIT_AS, (1024 * addresses_kb,) * 2)

    environment = {**os.environ, "PYTHONPATH": PACKAGE}
    return subprocess.run(
        [sys.executable, *words], preexec_fn=limit, env=environment, capture_output=True, text=True, timeout=100
    )


@pytest.fixture
def scan(tmp_path: Path) -> Path:
    write_cloud(PointCloud(*torus(300, np.random.default_rng(0))), tmp_path / "scan.ply")
    return tmp_path / "scan.ply"


def commands(scan: Path) -> dict[str, list[str]]:
    mesh, folder = str(scan.with_name("mesh.ply")), str(scan.with_name("meshes"))
    return {
        "run": [str(scan), "-o", mesh],
        "batch": ["batch", str(scan), "-o", folder],
        "limited": [str(scan), "-o", mesh, "--memory", "40MB"],
    }


@pytest.mark.parametrize(
    ("kind", "addresses_kb", "words"),
    [
        ("run", 700_000, "and the limit of the shell (ulimit -v) leaves"),
        ("batch", 1_500_000, "and the limit of the shell (ulimit -v) leaves"),
        ("limited", None, "the limit is 40 MB (--memory)."),
    ],
)
def test_a_sentence_and_no_file(scan: Path, kind: str, addresses_kb: int | None, words: str) -> None:
    done = ended(["-m", "gnrecon", *commands(scan)[kind]], addresses_kb)
    assert (done.returncode, done.stdout) == (ExitCode.MEMORY, ""), done.stderr
    assert done.stderr.startswith("gnrecon: ")
    assert done.stderr.count("\n") == 1
    assert words in done.stderr
    assert [path.name for path in scan.parent.iterdir()] == ["scan.ply"]


@pytest.mark.parametrize(
    ("deed", "code", "printed"),
    [
        ("os.abort()", ExitCode.MEMORY, "gnrecon: Native code ended the run by signal 6, most likely"),
        ("ctypes.CDLL(None).exit(1)", ExitCode.MEMORY, "gnrecon: Native code ended the run by exit code 1, most"),
        ("sys.exit(3)", ExitCode.INPUT, ""),
        ("sys.exit(0)", ExitCode.OK, ""),
        ("os.kill(os.getppid(), signal.SIGTERM); time.sleep(60)", ExitCode.INTERRUPTED, ""),
    ],
)
def test_how_a_child_ends(deed: str, code: ExitCode, printed: str) -> None:
    lines = (
        "import ctypes, os, signal, sys, time",
        "from gnrecon.cli.supervision import continue_in_child",
        "continue_in_child()",
        deed,
    )
    done = ended(["-c", "\n".join(lines)])
    assert (done.returncode, done.stderr[: len(printed)]) == (code, printed)
    assert done.stderr.count("\n") == bool(printed)


def test_native_code_that_asks_for_memory_for_ever_is_ended() -> None:
    """OpenBLAS does so where it finds no room for its buffers; here, reads of zeros take the time in the system."""
    lines = (
        "import mmap, os",
        "from gnrecon.cli.supervision import continue_in_child",
        "continue_in_child()",
        "zeros, buffer, kept = os.open('/dev/zero', os.O_RDONLY), bytearray(1 << 20), []",
        "try:",
        "    while True:",
        "        kept.append(mmap.mmap(-1, 1 << 20))",
        "except OSError:",
        "    while True:",
        "        os.readv(zeros, [buffer])",
    )
    done = ended(["-c", "\n".join(lines)], 700_000)
    assert (done.returncode, done.stdout) == (ExitCode.MEMORY, ""), done.stderr
    assert "ended the run by signal 6, most likely because a limit left it no memory" in done.stderr
