"""Packages of other people, installed into a folder as pip would: a module, and its metadata with entry points."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import numpy.typing as npt

Float = npt.NDArray[np.float64]

ACME = """
import numpy as np
from gnrecon import Mesh, PointCloud

def read(path):
    rows = np.load(path)
    return PointCloud(rows["points"], rows["normals"], {"heat": rows["points"][:, 2]})

def read_mesh(path):
    rows = np.load(path)
    return Mesh(rows["vertices"], rows["faces"])

def write(mesh, path):
    with path.open("wb") as file:
        np.savez(file, vertices=mesh.vertices, faces=mesh.faces)

def write_less(mesh, path):
    write(Mesh(mesh.vertices, mesh.faces[1:]), path)
"""
"""A package that reads clouds and meshes, and writes meshes, one of its writers badly."""

GROUPS = {"readers": "gnrecon.readers", "writers": "gnrecon.writers", "residuals": "gnrecon.residuals"}


def install(folder: Path, name: str, code: str, **entries: Mapping[str, str]) -> None:
    """Install a package into a folder: its one module, and entry points by `GROUPS`, each a name and an object."""
    (folder / f"{name}.py").write_text(code)
    metadata = folder / f"{name}-1.2.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.2\n")
    lines = [
        line
        for group, objects in entries.items()
        for line in (f"[{GROUPS[group]}]", *(f"{key} = {name}:{found}" for key, found in objects.items()))
    ]
    (metadata / "entry_points.txt").write_text("\n".join(lines) + "\n")


@contextmanager
def packages(folder: Path) -> Iterator[Path]:
    """Let Python find the packages of a folder while the block runs, and forget their modules after it."""
    before = set(sys.modules)
    sys.path.insert(0, str(folder))
    try:
        yield folder
    finally:
        sys.path.remove(str(folder))
        for name in set(sys.modules) - before:
            if str(getattr(sys.modules[name], "__file__", "")).startswith(str(folder)):
                del sys.modules[name]


def install_acme(folder: Path) -> None:
    """Install `ACME`, whose clouds are .acme and whose meshes .acmesh, and can be written as .lossy and .acme-only."""
    readers = {"acme": "read", "acmesh": "read_mesh", "lossy": "read_mesh", "ply": "read"}
    install(
        folder, "acme", ACME, readers=readers, writers={"acmesh": "write", "acme-only": "write", "lossy": "write_less"}
    )


def acme_scan(path: Path, points: Float, normals: Float) -> Path:
    """Write a cloud as `ACME` reads it."""
    with path.open("wb") as file:
        np.savez(file, points=points, normals=normals)
    return path
