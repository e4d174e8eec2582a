"""The examples run as they are documented: a folder is watched, and scripts of other libraries go through gnrecon."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
import open3d_pipeline
import pymeshlab_pipeline
import pytest
import watch_folder
from scan_files import torus, write_scan

from gnrecon.export import require_sound
from gnrecon.io import read_mesh

REPOSITORY = Path(__file__).resolve().parents[1]
FEW: dict[str, Any] = {"widths": (200,), "steps": 0, "resolution": 24}


class Script(Event):
    """Between two looks, does what comes next, and ends the watch after the last."""

    def __init__(self, *actions: Callable[[], object]) -> None:
        super().__init__()
        self._actions = list(actions)

    def wait(self, timeout: float | None = None) -> bool:
        del timeout
        if not self._actions:
            self.set()
        else:
            self._actions.pop(0)()
        return self.is_set()


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path]:
    incoming, meshes = tmp_path / "incoming", tmp_path / "meshes"
    incoming.mkdir()
    meshes.mkdir()
    return incoming, meshes


@pytest.fixture
def scan(tmp_path: Path) -> Path:
    return write_scan(tmp_path / "ring.ply", *torus(600, np.random.default_rng(3)))


def names(folder: Path) -> list[str]:
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())


def nothing() -> None:
    pass


def test_a_scan_is_taken_once_it_is_complete_and_only_once(
    folders: tuple[Path, Path], scan: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO", "watch_folder")
    incoming, meshes = folders
    content, arriving = scan.read_bytes(), incoming / "ring.ply"
    (incoming / ".hidden.ply").write_bytes(content)
    (incoming / "notes.md").write_text("no scan")

    def write(part: bytes) -> None:
        assert not names(meshes)
        with arriving.open("ab") as file:
            file.write(part)

    half = len(content) // 2
    parts = (lambda: write(content[:half]), lambda: write(content[half:]))
    watch_folder.watch(incoming, meshes, FEW, Script(*parts, nothing, nothing, nothing))
    assert names(meshes) == ["ring.ply.ply"]
    require_sound(read_mesh(meshes / "ring.ply.ply"))
    assert names(incoming) == [".hidden.ply", "done/ring.ply", "notes.md"]
    assert (incoming / "done" / "ring.ply").read_bytes() == content
    assert [record.getMessage() for record in caplog.records].count(str(arriving)) == 1


def test_failures_are_set_aside_with_the_reason(folders: tuple[Path, Path]) -> None:
    incoming, meshes = folders

    def arrive() -> None:
        (incoming / "bad.xyz").write_text("1 2 3\n")

    watch_folder.watch(incoming, meshes, FEW, Script(arrive, nothing, arrive, nothing, nothing))
    assert names(meshes) == []
    assert names(incoming) == [f"failed/bad{end}" for end in (".2.xyz", ".2.xyz.reason.txt", ".xyz", ".xyz.reason.txt")]
    assert "Only 1 of 1 points are usable" in (incoming / "failed" / "bad.xyz.reason.txt").read_text()


class Soon(Event):
    """Is set during a reconstruction: after a number of checks."""

    left = 6

    def is_set(self) -> bool:
        self.left -= 1
        return self.left < 0


def test_the_watch_ends_within_a_reconstruction_and_leaves_the_scan(folders: tuple[Path, Path], scan: Path) -> None:
    incoming, meshes = folders
    scan.rename(incoming / "ring.ply")
    stop = Soon()
    watch_folder.watch(incoming, meshes, FEW, stop, interval=0.01)
    assert stop.left < 0
    assert names(meshes) == []
    assert names(incoming) == ["ring.ply"]


def test_sigterm_ends_the_watch(folders: tuple[Path, Path]) -> None:
    command = [sys.executable, str(REPOSITORY / "examples" / "watch_folder.py"), *map(str, folders)]
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY)}
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment) as process:
        assert process.stderr is not None
        assert "Watching" in process.stderr.readline()
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 0
        assert process.stderr.read() == ""


def test_the_open3d_script(scan: Path, tmp_path: Path) -> None:
    mesh = tmp_path / "mesh.ply"
    # With half of the units, it depends on the draw whether the coarse mesh crosses itself.
    found = open3d_pipeline.pipeline(scan, mesh, voxel=0.1, **FEW | {"widths": (400,)})
    assert 200 < found.used < found.points == 600
    assert found.watertight
    assert found.mean < 0.02
    assert found.mean <= found.largest < 0.2
    require_sound(read_mesh(mesh))


def test_the_pymeshlab_script(scan: Path, tmp_path: Path) -> None:
    mesh = tmp_path / "mesh.ply"
    found = pymeshlab_pipeline.pipeline(scan, mesh, points=400, **FEW)
    assert found["boundary_edges"] == 0
    assert found["genus"] == 1
    require_sound(read_mesh(mesh))


def test_the_pyvista_script(scan: Path, tmp_path: Path) -> None:
    pytest.importorskip("pyvista", reason="pyvista is not installed")
    import pyvista_pipeline

    surface = pyvista_pipeline.pipeline(scan, tmp_path / "mesh.vtp", **FEW)
    assert surface.is_manifold
    assert {"distance", "Normals"} <= set(surface.point_data)
    require_sound(read_mesh(tmp_path / "mesh.vtp"))
