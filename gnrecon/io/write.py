"""Writes a mesh or a cloud atomically, in the format of the file's extension, and reports what is lost."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from gnrecon.geometry.arrays import Float, Values
from gnrecon.geometry.colors import as_bytes
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.io.contents import no_faces
from gnrecon.io.format_registry import ATTRIBUTE_SUPPORT, CLOUD_WRITERS, is_readable, writable, writer_of
from gnrecon.io.io_parameters import IOParameters
from gnrecon.io.origin import float32_origin, float32_rounding, origin_remark
from gnrecon.runtime.errors import MeshError, OutputError, UsageError
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
    extension, write = _writer(path)
    if not len(mesh.faces):
        raise MeshError("The mesh has no faces, so there is nothing to write.")
    if not np.isfinite(mesh.vertices).all():
        raise MeshError("The mesh has vertices that are not finite, so it is not written.")
    # Most formats and readers store indices as signed 32-bit integers.
    if len(mesh.vertices) >= 2**31:
        raise MeshError(f"The mesh has {len(mesh.vertices)} vertices, more than 32-bit indices allow.")
    held = {name: values for name, values in mesh.attributes.items() if _supports(extension, name, values)}
    stored, unread = _rounding_remark(mesh, path), unverified_remark(path)
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
    path : file to write; its extension gives the format
    overwrite, verify : as for `write_mesh`

    Raises
    ------
    UsageError
        When a cloud cannot be written with that extension.
    OutputError
        When the file cannot be written.
    """
    extension = Path(path).suffix.lower()
    if extension not in CLOUD_WRITERS:
        supported = ", ".join(suffix[1:] for suffix in CLOUD_WRITERS)
        raise UsageError(
            f"Points cannot be written as {extension or 'a file without an extension'!r}; use {supported}."
        )
    with atomic_write(path, overwrite, verify) as temporary:
        CLOUD_WRITERS[extension](Mesh(cloud.points, no_faces(), cloud.normals, cloud.attributes), temporary)


def supports_attribute(path: str | Path, name: str, values: Values) -> bool:
    """Whether the format of the path's extension can store a vertex attribute.

    Raises
    ------
    UsageError
        When the extension is not supported.
    """
    return _supports(check_writable(path), name, values)


def written_origin(mesh: Mesh, path: str | Path) -> Float | None:
    """Return the origin, of shape (3,), that the coordinates in a mesh's file are relative to; None for (0, 0, 0)."""
    return float32_origin(mesh) if Path(path).suffix.lower() == ".stl" else None


def check_writable(path: str | Path) -> str:
    """Return the extension of `path` if meshes can be written in that format.

    Raises
    ------
    UsageError
        When the extension is not supported, or its plugin cannot be loaded.
    """
    return _writer(path)[0]


def unverified_remark(path: str | Path) -> list[str]:
    """Return a sentence where no reader is installed for the path's extension, so that the file is not verified."""
    extension = Path(path).suffix.lower()
    if is_readable(extension):
        return []
    return [f"{path} was not read back and verified, because no installed package reads {extension[1:].upper()}."]


def _writer(path: str | Path) -> tuple[str, Callable[[Mesh, Path], None]]:
    """The extension of `path` and its writer; the errors are those of `check_writable`."""
    extension = Path(path).suffix.lower()
    write = writer_of(extension)
    if write is None:
        supported = ", ".join(suffix[1:] for suffix in writable())
        raise UsageError(
            f"A mesh cannot be written as {extension or 'a file without an extension'!r}; use {supported}."
        )
    return extension, write


def _supports(extension: str, name: str, values: Values) -> bool:
    """Whether a format can store an attribute; a plugin's format is assumed to store all."""
    return extension not in ATTRIBUTE_SUPPORT or ATTRIBUTE_SUPPORT[extension](name, values)


def _lost(mesh: Mesh, held: Mapping[str, Values], extension: str) -> list[str]:
    """Return a sentence on the attributes that the format cannot store."""
    lost = [name for name in mesh.attributes if name not in held]
    if not lost:
        return []
    names = " and ".join(filter(None, [", ".join(lost[:-1]), lost[-1]]))
    return [f"{extension[1:].upper()} cannot hold {names} of the vertices; PLY can."]


def _rounding_remark(mesh: Mesh, path: str | Path) -> list[str]:
    """Return a sentence on how STL stores coordinates, where float32 rounding is visible at the mesh's size."""
    if Path(path).suffix.lower() != ".stl":
        return []
    origin = written_origin(mesh, path)
    if origin is not None:
        return [origin_remark(origin)]
    moved = float32_rounding(mesh.vertices)
    if moved <= IOParameters.visible_rounding_diagonals * float(np.linalg.norm(np.ptp(mesh.vertices, axis=0))):
        return []
    return [f"STL stores float32: coordinates are rounded by up to {moved:.2g} units; PLY or OBJ keep them exactly."]


def round_trip_losses(before: Mesh | PointCloud, after: Mesh | PointCloud) -> list[str]:
    """Compare a mesh or cloud with what was read back from its file, and return a sentence on each kind of loss.

    Raises
    ------
    OutputError
        When numbers of points or faces differ, so that the file cannot be trusted.
    """
    sentences = _corner_losses(before, after) if isinstance(before, Mesh) and isinstance(after, Mesh) else []
    if isinstance(before, Mesh) and isinstance(after, PointCloud):
        sentences.append(f"The {len(before.faces)} faces are not kept: the format holds points only.")
    if isinstance(before, PointCloud) or isinstance(after, PointCloud):
        sentences += _point_losses(_positions(before), _positions(after))
    if before.normals is not None and after.normals is None:
        sentences.append("Normals are not kept: the format has no place for them.")
    return sentences + _attribute_losses(before, after)


def _positions(shape: Mesh | PointCloud) -> Float:
    return shape.vertices if isinstance(shape, Mesh) else shape.points


def _corner_losses(before: Mesh, after: Mesh) -> list[str]:
    """Compare the corners of faces, because vertices may have been merged and reordered."""
    if len(before.faces) != len(after.faces):
        raise OutputError(f"{len(after.faces)} of {len(before.faces)} faces could be read back from the written file.")
    sentences = []
    if len(before.vertices) != len(after.vertices):
        sentences.append(
            f"{len(before.vertices)} vertices became {len(after.vertices)}: the format joins or splits them."
        )
    return sentences + _point_losses(before.corners.reshape(-1, 3), after.corners.reshape(-1, 3))


def _point_losses(before: Float, after: Float) -> list[str]:
    if len(before) != len(after):
        raise OutputError(f"{len(after)} of {len(before)} points could be read back from the written file.")
    with np.errstate(invalid="ignore", over="ignore"):
        gap = np.nanmax(np.abs(before - after), initial=0.0)
    # A change of units or frame rounds coordinates by a few times the float64 epsilon in any case.
    if gap <= 4 * np.finfo(np.float64).eps * np.nanmax(np.abs(before[np.isfinite(before)]), initial=0.0):
        return []
    return [f"Coordinates are rounded by up to {gap:.2g} units."]


def _attribute_losses(before: Mesh | PointCloud, after: Mesh | PointCloud) -> list[str]:
    sentences = []
    for name, values in before.attributes.items():
        if name == "colors" and _finer_than_bytes(values):
            sentences.append("Colours are rounded to 8 bits.")
        elif name != "colors" and name in after.attributes and values.dtype.kind in "biuf":
            back = after.attributes[name].astype(np.float64)
            gap = (
                np.nanmax(np.abs(values.astype(np.float64) - back), initial=0.0) if back.shape == values.shape else 0.0
            )
            sentences += [f"Values of {name} are rounded by up to {gap:.2g}."] if gap > 0 else []
    return sentences


def _finer_than_bytes(colors: Values, *, tolerance: float = 1e-3) -> bool:
    """Whether colours, of shape (N, 3 or 4), are no 8-bit numbers on a scale of 1, 255 or 65535.

    `tolerance` is a share of full brightness: text files round colours to so few digits.
    """
    values, steps = colors.astype(np.float64), as_bytes(colors).astype(np.float64)
    return not any(
        np.abs(values - unit * steps).max(initial=0.0) <= 255 * unit * tolerance for unit in (1, 1 / 255, 257)
    )
