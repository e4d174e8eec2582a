"""Compressed scans and streams: bounded by the disk and by what scans are like, and gone with the process."""

from __future__ import annotations

import gzip
import io
import os
import shutil
import signal
import tempfile
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from gnrecon.io import read, read_cloud
from gnrecon.io.parse import OPEN_FILES
from gnrecon.runtime.errors import InputError


@pytest.fixture
def packed(tmp_path: Path) -> Path:
    rows = np.random.default_rng(0).normal(size=(200, 3))
    path = tmp_path / "scan.xyz.gz"
    path.write_bytes(gzip.compress("\n".join(" ".join(map(str, row)) for row in rows).encode()))
    return path


def test_what_the_disk_does_not_take_is_refused(packed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=5000))
    with pytest.raises(InputError, match=r"scan.xyz.gz: unpacked, it takes more than 0.0 MB, 90 % of what is free in"):
        read_cloud(packed)


def test_what_is_copied_is_not_called_unpacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=5_000_000))
    with pytest.raises(InputError, match=r"^copied, it takes more than 4.5 MB, 90 % of .*, where it is copied; TMPDIR"):
        read._copy(io.BytesIO(bytes(5_000_000)), tmp_path / "copy", None)


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


@pytest.mark.skipif(not OPEN_FILES.is_dir(), reason="needs the process's open files by number")
@pytest.mark.parametrize("extension", [".xyz", ".gltf", ".conf", ".plugin"])
def test_nothing_of_the_data_is_left_after_a_kill(packed: Path, tmp_path: Path, extension: str) -> None:
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        tempfile.tempdir = str(temporary)
        with read.uncompressed_file(packed, extension) as file:
            os.write(writer, f"{len(file.read_text().splitlines())} {file.suffix}".encode())
            os.kill(os.getpid(), signal.SIGKILL)
    assert os.waitpid(child, 0)[1] == signal.SIGKILL
    assert os.read(reader, 100).decode() == f"200 {extension if extension == '.plugin' else ''}"
    # A reader of a plugin gets a name, of which a link that leads nowhere remains.
    assert [path.name for path in temporary.rglob("*") if path.exists() and not path.is_dir()] == []
    assert extension == ".plugin" or list(temporary.iterdir()) == []


@pytest.mark.parametrize(("name", "content"), [("a.conf", "bmesh 0 0 0 0 0 0 0 1\n"), ("a.gltf", '{"buffers": [%s]}')])
def test_compressed_files_name_no_files_next_to_them(tmp_path: Path, name: str, content: str) -> None:
    """Their folder would be that of the process's open files."""
    (tmp_path / "0").write_text("x")
    path = tmp_path / f"{name}.gz"
    path.write_bytes(gzip.compress(content.replace("%s", '{"uri": "0", "byteLength": 1}').encode()))
    with pytest.raises(InputError, match=r"'0' lies next to it, where compressed files have none"):
        read_cloud(path)


def test_a_copy_has_a_name_where_open_files_have_no_number(packed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(read, "OPEN_FILES", Path("/nowhere"))
    with read.uncompressed_file(packed, ".xyz") as file:
        assert (file.name, len(file.read_text().splitlines())) == ("unpacked.xyz", 200)
    assert not file.parent.exists()
