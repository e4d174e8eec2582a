"""The tables of file formats, and how files are read and written by their extension.

To add a format, write a module in `gnrecon.io.formats` and add a line to the tables. Other extensions are looked up
among the plugins of installed packages. Their reader takes a path and returns a `PointCloud`, a `Mesh`, or anything
else that `as_shape` accepts; their writer takes a `Mesh` and a path. The returned values are checked like any input.
Plugins cannot replace built-in formats.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from copy import deepcopy
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from gnrecon.geometry.arrays import Values
from gnrecon.geometry.mesh import Mesh
from gnrecon.io.contents import Contents, concatenated
from gnrecon.io.formats.e57 import read_e57
from gnrecon.io.formats.gltf import glb_supports, read_gltf, write_glb
from gnrecon.io.formats.las import las_chunks, read_las
from gnrecon.io.formats.npy import read_npy
from gnrecon.io.formats.obj import read_obj, write_obj
from gnrecon.io.formats.off import read_off, write_off
from gnrecon.io.formats.pcd import read_pcd
from gnrecon.io.formats.ply import ply_chunks, read_ply, write_ply
from gnrecon.io.formats.ptx import ptx_chunks
from gnrecon.io.formats.stanford_conf import read_conf
from gnrecon.io.formats.stl import read_stl, write_stl
from gnrecon.io.formats.table import TABLE_SUFFIXES, table_chunks, write_table
from gnrecon.io.formats.threemf import read_3mf, write_3mf
from gnrecon.io.formats.vtk import read_vtk
from gnrecon.io.formats.vtp import read_vtp
from gnrecon.io.interop import as_shape
from gnrecon.io.io_parameters import IOParameters
from gnrecon.runtime.errors import InputError, OutputError
from gnrecon.runtime.plugins import Plugin, PluginKind, find, installed

CHUNK_READERS: dict[str, Callable[[Path, int], Iterator[Contents]]] = {
    ".las": las_chunks,
    ".laz": las_chunks,
    ".ply": ply_chunks,
    ".ptx": ptx_chunks,
    **{suffix: partial(table_chunks, extension=suffix) for suffix in TABLE_SUFFIXES},
}
"""Readers of a file's contents by chunks of at most so many points, with the same errors as those of whole files."""


def _read_whole(extension: str, path: Path) -> Contents:
    return concatenated(list(CHUNK_READERS[extension](path, IOParameters.chunk_points)))


READERS: dict[str, Callable[[Path], Contents]] = {
    ".ply": read_ply,
    ".pcd": read_pcd,
    **{suffix: partial(_read_whole, suffix) for suffix in TABLE_SUFFIXES},
    ".npy": read_npy,
    ".npz": read_npy,
    ".obj": read_obj,
    ".off": read_off,
    ".stl": read_stl,
    ".glb": read_gltf,
    ".gltf": read_gltf,
    ".3mf": read_3mf,
    ".las": read_las,
    ".laz": read_las,
    ".e57": read_e57,
    ".ptx": partial(_read_whole, ".ptx"),
    ".vtk": read_vtk,
    **dict.fromkeys((".vtp", ".vtu", ".vts"), read_vtp),
    ".conf": read_conf,
}
"""Readers of whole files. A file that is malformed, cut short or of another kind ends in an `InputError` of one
sentence on what is wrong, and so does a missing optional package."""

WRITERS: dict[str, Callable[[Mesh, Path], None]] = {
    ".obj": write_obj,
    ".ply": write_ply,
    ".stl": write_stl,
    ".off": write_off,
    ".glb": write_glb,
    ".3mf": write_3mf,
}

CLOUD_WRITERS: dict[str, Callable[[Mesh, Path], None]] = {
    ".ply": write_ply,
    ".xyz": write_table,
    ".txt": write_table,
    ".csv": write_table,
}
"""Writers of points without faces."""

ATTRIBUTE_SUPPORT: dict[str, Callable[[str, Values], bool]] = {
    **dict.fromkeys((".obj", ".off", ".3mf"), lambda name, _: name == "colors"),
    ".ply": lambda _, values: values.dtype.kind in "biuf",
    ".stl": lambda _, __: False,
    ".glb": glb_supports,
}
"""Whether a format can store a vertex attribute, by its name and values."""

SIGNATURES: dict[str, tuple[bytes, ...]] = {
    ".ply": (b"ply\n", b"ply\r"),
    ".pcd": (b"# .PCD", b"VERSION .7", b"VERSION 0.7"),
    ".off": (b"OFF", b"COFF", b"NOFF"),
    ".glb": (b"glTF",),
    ".las": (b"LASF",),
    ".e57": (b"ASTM-E57",),
    ".vtk": (b"# vtk DataFile",),
    ".npy": (b"\x93NUMPY",),
    "PNG image": (b"\x89PNG",),
    "JPEG image": (b"\xff\xd8\xff",),
    "PDF document": (b"%PDF",),
    "ZIP archive": (b"PK\x03\x04",),
}
"""First bytes of files of an extension or another kind."""


def is_readable(extension: str) -> bool:
    """Whether files of an extension, with its dot, can be read."""
    return extension in READERS or extension in readable()


def readable() -> list[str]:
    """Return the extensions, with their dots, of all files that can be read."""
    return _with_plugins(READERS, "reader")


def writable() -> list[str]:
    """Return the extensions, with their dots, of all files that a mesh can be written to."""
    return _with_plugins(WRITERS, "writer")


def reader_of(extension: str) -> Callable[[Path], Contents] | None:
    """Return the reader for files of an extension; None where there is none.

    `UsageError` is raised when several packages offer it, or the one that does cannot be loaded.
    """
    plugin = None if extension in READERS else find("reader", extension.removeprefix("."))
    return READERS.get(extension) if plugin is None else partial(_read_with_plugin, plugin, plugin.load())


def writer_of(extension: str) -> Callable[[Mesh, Path], None] | None:
    """Return the writer of meshes for files of an extension, as `reader_of` does the reader."""
    plugin = None if extension in WRITERS else find("writer", extension.removeprefix("."))
    return WRITERS.get(extension) if plugin is None else partial(_write_with_plugin, plugin, plugin.load())


def _with_plugins(built_in: dict[str, Any], kind: PluginKind) -> list[str]:
    return list(dict.fromkeys([*built_in, *(f".{plugin.entry.name}" for plugin in installed(kind))]))


def _read_with_plugin(plugin: Plugin, read: Callable[[Path], Any], path: Path) -> Contents:
    with plugin.guarded(InputError):
        found = read(path)
        try:
            shape = as_shape(found)
        except InputError as error:
            raise InputError(f"{plugin} returned something that is not a cloud: {error}") from error
        attributes = {name: np.asarray(values) for name, values in shape.attributes.items()}
        for name, column in attributes.items():
            if column.dtype.kind not in "biuf" or column.ndim > 2:
                found = f"the attribute {name!r} of type {column.dtype} and shape {column.shape}"
                raise InputError(f"{plugin} returned {found}, but numbers of shape (N,) or (N, C) were expected.")
        if isinstance(shape, Mesh):
            return Contents(shape.vertices, shape.normals, shape.faces, attributes)
        return Contents(shape.points, shape.normals, attributes=attributes, origins=shape.origins)


def _write_with_plugin(plugin: Plugin, write: Callable[[Mesh, Path], Any], mesh: Mesh, path: Path) -> None:
    with plugin.guarded(OutputError):
        write(deepcopy(mesh), path)  # the caller still uses its own
    if not path.is_file() or not path.stat().st_size:
        raise OutputError(f"{plugin.subject} wrote nothing.")
