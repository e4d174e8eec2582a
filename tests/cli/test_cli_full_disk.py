"""A disk that is full after any number of bytes: each writer reports it, and what was there before stays."""

from __future__ import annotations

import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from command_line import ball
from scan_files import torus

from gnrecon import run
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.io import write_cloud, write_mesh
from gnrecon.io.format_registry import CLOUD_WRITERS, WRITERS
from gnrecon.pipeline import reconstruct
from gnrecon.runtime.errors import OutputError


@contextmanager
def full_after(size: int) -> Iterator[None]:
    """Let the system refuse, while the block runs, what would make a file larger than `size` bytes."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize("existing", [False, True])
@pytest.mark.parametrize("suffix", sorted(WRITERS))
def test_meshes(tmp_path: Path, suffix: str, existing: bool) -> None:
    target = tmp_path / f"mesh{suffix}"
    write_mesh(ball(), target)
    size = target.stat().st_size
    if not existing:
        target.unlink()
    before = contents(tmp_path)
    for limit in (0, 100, size // 2, size - 1):
        with full_after(limit), pytest.raises(OutputError, match="could not be written"):
            write_mesh(ball(), target, overwrite=True)
        assert contents(tmp_path) == before


@pytest.mark.parametrize("suffix", sorted(CLOUD_WRITERS))
def test_clouds(tmp_path: Path, suffix: str) -> None:
    cloud, target = PointCloud(*torus(500, np.random.default_rng(0))), tmp_path / f"cloud{suffix}"
    write_cloud(cloud, target)
    size = target.stat().st_size
    target.unlink()
    for limit in (0, size // 2, size - 1):
        with full_after(limit), pytest.raises(OutputError, match="could not be written"):
            write_cloud(cloud, target)
        assert contents(tmp_path) == {}


def test_all_files_of_a_run_or_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run, "render", lambda mesh, path, size: path.write_bytes(bytes(mesh.faces) + bytes(size[0])))
    result = reconstruct(*torus(300, np.random.default_rng(0)), quality="draft", resolution=16)
    names = {
        "output": "mesh.ply",
        "report": "report.json",
        "model": "model.gnr",
        "html": "page.html",
        "thumbnail": "small.png",
        "config": "config.toml",
    }
    files = run.Files((tmp_path / "scan.ply",), **{kind: tmp_path / name for kind, name in names.items()})
    run._write(files, result)
    sizes = sorted(path.stat().st_size for path in tmp_path.iterdir())
    for path in tmp_path.iterdir():
        path.unlink()
    for limit in (0, sizes[1], sizes[-1] - 1):
        with full_after(limit), pytest.raises(OutputError, match="could not be written"):
            run._write(files, result)
        assert contents(tmp_path) == {}
