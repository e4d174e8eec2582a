"""Compressed scans and streams: bounded by the disk and by what scans are like, and gone with the process."""

from __future__ import annotations

import gzip
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from gnrecon.io import read, read_cloud
from gnrecon.runtime.errors import InputError


@pytest.fixture
def packed(tmp_path: Path) -> Path:
    rows = np.random.default_rng(0).normal(size=(200, 3))
    path = tmp_path / "scan.xyz.gz"
    path.write_bytes(gzip.compress("\n".join(" ".join(map(str, row)) for row in rows).encode()))
    return path


def test_what_the_disk_does_not_take_is_refused(packed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=5000))
    with pytest.raises(InputError, match=r"scan.xyz.gz: unpacked, it takes more than 0.0 GB, 90 % of what is free in"):
        read_cloud(packed)


def test_what_no_scan_is_like_is_refused(tmp_path: Path) -> None:
    bomb = tmp_path / "bomb.gz"
    bomb.write_bytes(gzip.compress(bytes(1_000_000)))
    with gzip.open(bomb) as source, pytest.raises(InputError, match="more than 200 times its size"):
        read._copy(source, tmp_path / "copy", bomb.stat().st_size, least_suspect_bytes=100_000)


def test_a_full_disk_is_named(packed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(read, "_copy", full)
    with pytest.raises(InputError, match=r"scan.xyz.gz: the file cannot be read: No space left on device"):
        read_cloud(packed)


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="needs the process's open files by number")
def test_nothing_is_left_after_a_kill(packed: Path, tmp_path: Path) -> None:
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    script = (
        "import os, signal; from pathlib import Path; from gnrecon.io.read import uncompressed_file\n"
        f"with uncompressed_file(Path({str(packed)!r}), '.xyz') as file:\n"
        "    print(len(file.read_text().splitlines()), flush=True)\n"
        "    os.kill(os.getpid(), signal.SIGKILL)"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], env={"TMPDIR": str(temporary)}, capture_output=True, text=True, timeout=60
    )
    assert (done.returncode, done.stdout) == (-signal.SIGKILL, "200\n"), done.stderr
    assert list(temporary.iterdir()) == []


def test_formats_that_name_their_siblings_have_a_folder(tmp_path: Path) -> None:
    path = tmp_path / "scan.gltf.gz"
    path.write_bytes(gzip.compress(b"{}"))
    with read.uncompressed_file(path, ".gltf") as file:
        assert (file.name, file.read_bytes()) == ("unpacked.gltf", b"{}")
    assert not file.parent.exists()
