"""How files are read and written by their extension: by the built-in table, else by what other packages bring.

A reader of another package takes a path and returns a `PointCloud`, a `Mesh`, or anything else that `as_shape` takes; a
writer takes a `Mesh` and a path. What comes back is checked as any input is, because nothing is known of that code.
Extensions that are built in stay what they are.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from gnrecon.geometry.arrays import Values
from gnrecon.geometry.mesh import Mesh
from gnrecon.io.contents import Contents
from gnrecon.io.formats import READERS, WRITERS
from gnrecon.io.objects import as_shape
from gnrecon.runtime.errors import InputError, OutputError
from gnrecon.runtime.plugins import READERS as READER_GROUP
from gnrecon.runtime.plugins import WRITERS as WRITER_GROUP
from gnrecon.runtime.plugins import Plugin, find, installed


def is_readable(extension: str) -> bool:
    """Whether files of an extension, with its dot, can be read."""
    return extension in READERS or extension in readable()


def readable() -> list[str]:
    """Return the extensions, with their dots, of all files that can be read."""
    return _all(READERS, READER_GROUP)


def writable() -> list[str]:
    """Return the extensions, with their dots, of all files that a mesh can be written to."""
    return _all(WRITERS, WRITER_GROUP)


def reader_of(extension: str) -> Callable[[Path], Contents] | None:
    """Return what reads files of an extension; None where nothing does.

    Raises
    ------
    UsageError
        When several packages offer it, or the one that does cannot be loaded.
    """
    if extension in READERS:
        return READERS[extension]
    plugin = find(READER_GROUP, extension.removeprefix("."))
    if plugin is None:
        return None
    read = plugin.load()
    return lambda path: _read(plugin, read, path)


def writer_of(extension: str) -> Callable[[Mesh, Path], None] | None:
    """Return what writes meshes to files of an extension; None where nothing does.

    Raises
    ------
    UsageError
        When several packages offer it, or the one that does cannot be loaded.
    """
    if extension in WRITERS:
        return WRITERS[extension]
    plugin = find(WRITER_GROUP, extension.removeprefix("."))
    if plugin is None:
        return None
    write = plugin.load()
    return lambda mesh, path: _write(plugin, write, mesh, path)


def _all(built_in: dict[str, Any], group: str) -> list[str]:
    return list(dict.fromkeys([*built_in, *(f".{plugin.entry.name}" for plugin in installed(group))]))


def _read(plugin: Plugin, read: Callable[[Path], Any], path: Path) -> Contents:
    with plugin.guarded(InputError):
        found = read(path)
    with plugin.guarded(InputError):
        try:
            shape = as_shape(found)
        except InputError as error:
            raise InputError(f"{plugin} returned what is no cloud: {error}") from error
        attributes = {name: _column(plugin, name, values) for name, values in shape.attributes.items()}
        if isinstance(shape, Mesh):
            return Contents(shape.vertices, shape.normals, shape.faces, attributes)
        return Contents(shape.points, shape.normals, attributes=attributes, origins=shape.origins)


def _column(plugin: Plugin, name: str, values: Any) -> Values:
    """The values of an attribute as an array of numbers, of shape (N,) or (N, C)."""
    column = np.asarray(values)
    if column.dtype.kind not in "biuf" or column.ndim > 2:
        raise InputError(
            f"{plugin} returned the attribute {name!r} of type {column.dtype} and shape {column.shape}, but numbers of "
            f"shape (N,) or (N, C) were expected."
        )
    return column


def _write(plugin: Plugin, write: Callable[[Mesh, Path], Any], mesh: Mesh, path: Path) -> None:
    with plugin.guarded(OutputError):
        write(_kept(mesh), path)
    if not path.is_file() or not path.stat().st_size:
        raise OutputError(f"{plugin.subject} wrote nothing.")


def _kept(mesh: Mesh) -> Mesh:
    """The same mesh in arrays that cannot be written to, because the caller's mesh is used after it was written."""
    normals = None if mesh.normals is None else _locked(mesh.normals)
    attributes = {name: _locked(values) for name, values in mesh.attributes.items()}
    return replace(
        mesh, vertices=_locked(mesh.vertices), faces=_locked(mesh.faces), normals=normals, attributes=attributes
    )


def _locked(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    view = values.view()
    view.flags.writeable = False
    return view
