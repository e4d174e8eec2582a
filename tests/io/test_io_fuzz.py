"""Damaged files of every format end in points or in one sentence.

More than two thousand files, made from valid ones by seeded mutations, are read in this process: an exception of any
other kind, a word on standard output or error, or a hang fails the test. Some are given to the command line too.
"""

from __future__ import annotations

import gzip
import signal
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

import numpy as np
import pytest
from benchmarks.damage import mutated
from scan_writers import FORMS, file_of, random_cloud

from gnrecon.cli.app import main
from gnrecon.geometry.mesh import Mesh
from gnrecon.io import read_scans, write_mesh
from gnrecon.runtime.errors import ExitCode, InputError, UsageError

MUTATIONS = 76
"""Of each of the forms, so that there are more than 2,000 in all."""

SECONDS = 20
"""In which any file of a few kilobytes must be read, on a machine that is busy."""


def mesh_of(suffix: str, folder: Path) -> Path:
    mesh = Mesh(np.random.default_rng(0).normal(size=(6, 3)), [[0, 1, 2], [3, 4, 5], [0, 1, 5]])
    write_mesh(mesh, folder / f"a{suffix}")
    return folder / f"a{suffix}"


def conf_of(folder: Path) -> Path:
    file_of("ply", random_cloud(np.random.default_rng(0), 20), folder)
    path = folder / "a.conf"
    path.write_text("camera 0 0 0 0 0 0 1\nbmesh scan.ply 0 0 0 0 0 0 1\nmesh scan.ply 1 2 3 0.1 0.2 0.3 0.9\n")
    return path


def valid(name: str, folder: Path) -> Path:
    if name == "conf":
        return conf_of(folder)
    if name in (".stl", ".3mf"):
        return mesh_of(name, folder)
    return file_of(name, random_cloud(np.random.default_rng(0), 20), folder)


NAMES = [*FORMS, "conf", ".stl", ".3mf"]


@contextmanager
def within(seconds: int) -> Iterator[None]:
    def late(number: int, frame: FrameType | None) -> None:
        raise AssertionError(f"not read within {seconds} s ({number}, {frame})")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def test_there_are_more_than_two_thousand() -> None:
    assert len(NAMES) * MUTATIONS > 2000


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", NAMES)
def test_damaged_files_end_in_points_or_in_one_sentence(
    name: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    source = valid(name, tmp_path)
    content = source.read_bytes()
    rng = np.random.default_rng(sum(name.encode()))
    sentences = []
    for number in range(MUTATIONS):
        # Half of the damage to a compressed file is done to what is within.
        inner = name.endswith("-gz") and number % 2
        damaged = gzip.compress(mutated(gzip.decompress(content), rng)) if inner else mutated(content, rng)
        source.write_bytes(damaged)
        try:
            with within(SECONDS):
                cloud, _ = read_scans([source])
        except InputError as error:
            sentences.append(str(error))
        else:
            assert len(cloud) > 0
    assert sentences, "the damage is none"
    assert not [sentence for sentence in sentences if "\n" in sentence or not sentence.startswith(str(source))]
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("name", ["ply", "laz", "vtp-compressed", "e57"])
def test_the_command_line_ends_in_a_mesh_or_in_exit_code_3(
    name: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    source = valid(name, tmp_path)
    content = source.read_bytes()
    rng = np.random.default_rng(7)
    for _ in range(40):
        source.write_bytes(mutated(content, rng))
        try:
            read_scans([source])
        except (InputError, UsageError):
            break
    else:
        raise AssertionError("none of the mutations is refused")
    target = tmp_path / "mesh.ply"
    with pytest.raises(SystemExit) as end:
        main([str(source), "-o", str(target)])
    printed = capfd.readouterr()
    assert end.value.code == ExitCode.INPUT, printed.err
    assert printed.out == ""
    assert printed.err.startswith("gnrecon: ")
    assert printed.err.count("\n") == 1
    assert not target.exists()


def test_temporary_files_are_gone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    path = file_of("xyz-gz", random_cloud(np.random.default_rng(0), 20), tmp_path)
    read_scans([path])
    path.write_bytes(path.read_bytes()[:-9])
    with pytest.raises(InputError):
        read_scans([path])
    assert not list((tmp_path / "temporary").iterdir())
