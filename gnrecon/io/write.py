"""Writes a mesh or a cloud atomically, in the format of the file's extension, and reports what is lost."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from gnrecon.geometry.arrays import Float, Values
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.io.contents import no_faces
from gnrecon.io.format_registry import ATTRIBUTE_SUPPORT, CLOUD_WRITERS, is_readable, writable, writer_of
from gnrecon.io.formats.stl import float32_origin, rounding_remark
from gnrecon.io.io_parameters import IOParameters
from gnrecon.runtime.errors import MeshError, UsageError
from gnrecon.runtime.files import atomic_write

_log = logging.getLogger(__name__)


def write_mesh(
    mesh: Mesh, path: str | Path, overwrite: bool = False, verify: Callable[[Path], object] | None = None
) -> list[str]:
    """Write a mesh and return sentences on what the format could not keep.

    Parameters
    ----------
    mesh : in file units
    path : file to write; its extension gives the format
    overwrite : whether an existing file may be replaced
    verify : called with the temporary file before it is renamed to `path`; an exception prevents that. Not called for
        a plugin's format that nothing can read back; then a sentence says so

    Raises
    ------
    UsageError
        When the extension is not supported.
    MeshError
        When the mesh has no faces, or coordinates are not finite.
    OutputError
        When the file cannot be written.
    """
    extension = check_writable(path)
    if not len(mesh.faces):
        raise MeshError("The mesh has no faces, so there is nothing to write.")
    if not np.isfinite(mesh.vertices).all():
        raise MeshError("The mesh has vertices that are not finite, so it is not written.")
    # Most formats and readers store indices as signed 32-bit integers.
    if len(mesh.vertices) >= 2**31:
        raise MeshError(f"The mesh has {len(mesh.vertices)} vertices, more than 32-bit indices allow.")
    write = writer_of(extension)
    assert write is not None, "other extensions are refused"
    held = {name: values for name, values in mesh.attributes.items() if supports_attribute(path, name, values)}
    visible = IOParameters.visible_rounding_diagonals
    stored = rounding_remark(mesh, visible_diagonals=visible) if extension == ".stl" else []
    unread = unverified_remark(path)
    try:
        with atomic_write(path, overwrite, None if unread else verify) as temporary:
            write(replace(mesh, attributes=held), temporary)
    except MeshError as error:
        # The likely reason is rounding, on which `stored` has a sentence.
        raise MeshError("; ".join([str(error).removesuffix("."), *stored]).removesuffix(".") + ".") from error
    _log.info("Wrote %d vertices and %d faces to %s.", len(mesh.vertices), len(mesh.faces), path)
    return _lost(mesh, held, extension) + stored + unread


def write_cloud(
    cloud: PointCloud, path: str | Path, overwrite: bool = False, verify: Callable[[Path], object] | None = None
) -> None:
    """Write points with their normals and all their attributes; colours are written as 8-bit numbers.

    Parameters
    ----------
    cloud : in file units
    path, overwrite, verify : as for `write_mesh`, and so are the errors
    """
    extension = Path(path).suffix.lower()
    if extension not in CLOUD_WRITERS:
        raise _unknown("Points", extension, CLOUD_WRITERS)
    with atomic_write(path, overwrite, verify) as temporary:
        CLOUD_WRITERS[extension](Mesh(cloud.points, no_faces(), cloud.normals, cloud.attributes), temporary)


def supports_attribute(path: str | Path, name: str, values: Values) -> bool:
    """Whether the format of the path's extension, which `check_writable` accepts, can store a vertex attribute.

    A plugin's format is assumed to store all.
    """
    holds = ATTRIBUTE_SUPPORT.get(check_writable(path))
    return holds is None or holds(name, values)


def written_origin(mesh: Mesh, path: str | Path) -> Float | None:
    """Return the origin, of shape (3,), that the coordinates in a mesh's file are relative to; None for (0, 0, 0)."""
    return float32_origin(mesh) if Path(path).suffix.lower() == ".stl" else None


def check_writable(path: str | Path) -> str:
    """Return the extension of `path` if meshes can be written in that format; raise `UsageError` otherwise."""
    extension = Path(path).suffix.lower()
    if writer_of(extension) is None:
        raise _unknown("A mesh", extension, writable())
    return extension


def unverified_remark(path: str | Path) -> list[str]:
    """Return a sentence where no reader is installed for the path's extension, so that the file is not verified."""
    extension = Path(path).suffix.lower()
    if is_readable(extension):
        return []
    return [f"{path} was not read back and verified, because no installed package reads {extension[1:].upper()}."]


def _unknown(what: str, extension: str, known: Iterable[str]) -> UsageError:
    supported = ", ".join(suffix[1:] for suffix in known)
    return UsageError(f"{what} cannot be written as {extension or 'a file without an extension'!r}; use {supported}.")


def _lost(mesh: Mesh, held: Mapping[str, Values], extension: str) -> list[str]:
    """Return a sentence on the attributes that the format cannot store."""
    lost = [name for name in mesh.attributes if name not in held]
    if not lost:
        return []
    names = " and ".join(filter(None, [", ".join(lost[:-1]), lost[-1]]))
    return [f"{extension[1:].upper()} cannot hold {names} of the vertices; PLY can."]
