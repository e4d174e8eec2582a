"""Writing a mesh or a cloud, in the format that the file's extension names, atomically."""

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
from gnrecon.io.format_registry import CLOUD_WRITERS, HOLDS, is_readable, writable, writer_of
from gnrecon.io.origin import far_origin, rounding, told
from gnrecon.runtime.errors import MeshError, OutputError, UsageError
from gnrecon.runtime.files import atomic_write

_NOTABLE_ROUNDING = 1e-6  # of the mesh's diagonal

_INT32_LIMIT = 2**31

_log = logging.getLogger(__name__)


def write_mesh(
    mesh: Mesh, path: str | Path, overwrite: bool = False, verify: Callable[[Path], None] | None = None
) -> list[str]:
    """Write a mesh and return sentences about what the format could not keep.

    Parameters
    ----------
    mesh : in file units
    path : target; its extension names the format
    overwrite : whether an existing file may be replaced
    verify : called with the temporary file before it receives the target's name; what it raises prevents that. Not
        called where nothing reads the format back, as it may be with those of other packages; a sentence says so

    Raises
    ------
    UsageError
        When the extension is no supported one.
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
    if len(mesh.vertices) >= _INT32_LIMIT:
        raise MeshError(f"The mesh has {len(mesh.vertices)} vertices, more than 32-bit indices can name.")
    held = {name: values for name, values in mesh.attributes.items() if _holds(extension, name, values)}
    stored, unread = _stored(mesh, path), unverified(path)
    try:
        with atomic_write(path, overwrite, None if unread else verify) as temporary:
            write(replace(mesh, attributes=held), temporary)
    except MeshError as error:
        # Rounding is then the likely reason.
        raise MeshError("; ".join([str(error).removesuffix("."), *stored]).removesuffix(".") + ".") from error
    _log.info("Wrote %d vertices and %d faces to %s.", len(mesh.vertices), len(mesh.faces), path)
    return _lost(mesh, held, extension) + stored + unread


def write_cloud(
    cloud: PointCloud, path: str | Path, overwrite: bool = False, verify: Callable[[Path], None] | None = None
) -> None:
    """Write points with their normals and all their attributes, colours as 8-bit numbers.

    Parameters
    ----------
    cloud : in file units
    path : target; its extension names the format
    overwrite, verify : as of `write_mesh`

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


def holds(path: str | Path, name: str, values: Values) -> bool:
    """Whether the format that the path's extension names can hold such an attribute of vertices.

    Raises
    ------
    UsageError
        When the extension is no supported one.
    """
    return _holds(check_writable(path), name, values)


def written_origin(mesh: Mesh, path: str | Path) -> Float | None:
    """Return the origin, of shape (3,), that coordinates are relative to in a mesh's file; None for the mesh's own."""
    return far_origin(mesh) if Path(path).suffix.lower() == ".stl" else None


def check_writable(path: str | Path) -> str:
    """Return the extension of `path` when a mesh can be written so.

    Raises
    ------
    UsageError
        When the extension is no supported one, or its writer, of another package, cannot be loaded.
    """
    return _writer(path)[0]


def unverified(path: str | Path) -> list[str]:
    """Return a sentence where nothing reads the format that the path's extension names, so that it is not verified."""
    extension = Path(path).suffix.lower()
    if is_readable(extension):
        return []
    return [f"{path} was not read back and verified, because nothing that is installed reads {extension[1:].upper()}."]


def _writer(path: str | Path) -> tuple[str, Callable[[Mesh, Path], None]]:
    """The extension of `path`, and what writes meshes so; the errors are those of `check_writable`."""
    extension = Path(path).suffix.lower()
    write = writer_of(extension)
    if write is None:
        supported = ", ".join(suffix[1:] for suffix in writable())
        raise UsageError(
            f"A mesh cannot be written as {extension or 'a file without an extension'!r}; use {supported}."
        )
    return extension, write


def _holds(extension: str, name: str, values: Values) -> bool:
    """Whether a format can hold an attribute; what other packages' formats hold is their own affair."""
    return extension not in HOLDS or HOLDS[extension](name, values)


def _lost(mesh: Mesh, held: Mapping[str, Values], extension: str) -> list[str]:
    """Return a sentence about attributes that the format has no place for."""
    lost = [name for name in mesh.attributes if name not in held]
    if not lost:
        return []
    named = " and ".join(filter(None, [", ".join(lost[:-1]), lost[-1]]))
    return [f"{extension[1:].upper()} cannot hold {named} of the vertices; PLY can."]


def _stored(mesh: Mesh, path: str | Path) -> list[str]:
    """Return a sentence about how coordinates are stored, where it is in float32 and notable beside the mesh's size."""
    if Path(path).suffix.lower() != ".stl":
        return []
    origin = written_origin(mesh, path)
    if origin is not None:
        return [told(origin)]
    moved = rounding(mesh.vertices)
    if moved <= _NOTABLE_ROUNDING * float(np.linalg.norm(np.ptp(mesh.vertices, axis=0))):
        return []
    return [f"STL stores float32: coordinates are rounded by up to {moved:.2g} units; PLY or OBJ keep them exactly."]


_DIGITS = 4 * np.finfo(np.float64).eps
"""Rounding that the same numbers in another frame have anyway, as a share of the largest coordinate."""

_COLOR_STEP = 1e-3
"""Rounding of colours, as a share of full brightness, that is no more than the digits of a text file."""


# What a written file no longer says of the mesh or cloud that it was made from, found by reading it back.


def losses(before: Mesh | PointCloud, after: Mesh | PointCloud) -> list[str]:
    """Say what differs, one sentence for each kind of thing; attributes that both have are compared by name.

    Raises
    ------
    OutputError
        When faces are not those that were written, so that the file cannot be trusted.
    """
    sentences = _of_corners(before, after) if isinstance(before, Mesh) and isinstance(after, Mesh) else []
    if isinstance(before, Mesh) and isinstance(after, PointCloud):
        sentences.append(f"The {len(before.faces)} faces are not kept: the format holds points only.")
    if isinstance(before, PointCloud) or isinstance(after, PointCloud):
        sentences += _of_points(_places(before), _places(after))
    if before.normals is not None and after.normals is None:
        sentences.append("Normals are not kept: the format has no place for them.")
    return sentences + _of_attributes(before, after)


def _places(shape: Mesh | PointCloud) -> Float:
    return shape.vertices if isinstance(shape, Mesh) else shape.points


def _of_corners(before: Mesh, after: Mesh) -> list[str]:
    """Compare the faces' corners, because vertices may have come back joined and in another order."""
    if len(before.faces) != len(after.faces):
        raise OutputError(f"{len(after.faces)} of {len(before.faces)} faces came back from the file that was written.")
    sentences = []
    if len(before.vertices) != len(after.vertices):
        sentences.append(
            f"{len(before.vertices)} vertices became {len(after.vertices)}: the format joins or splits them."
        )
    return sentences + _of_points(before.corners.reshape(-1, 3), after.corners.reshape(-1, 3))


def _of_points(before: Float, after: Float) -> list[str]:
    if len(before) != len(after):
        raise OutputError(f"{len(after)} of {len(before)} points came back from the file that was written.")
    with np.errstate(invalid="ignore", over="ignore"):
        gap = np.nanmax(np.abs(before - after), initial=0.0)
    if gap <= _DIGITS * np.nanmax(np.abs(before[np.isfinite(before)]), initial=0.0):
        return []
    return [f"Coordinates are rounded by up to {gap:.2g} units."]


def _of_attributes(before: Mesh | PointCloud, after: Mesh | PointCloud) -> list[str]:
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


def _finer_than_bytes(colors: Values) -> bool:
    """Whether colours, of shape (N, 3 or 4), have steps that 8-bit numbers do not, on whichever scale they are."""
    values, steps = colors.astype(np.float64), as_bytes(colors).astype(np.float64)
    return not any(
        np.abs(values - unit * steps).max(initial=0.0) <= 255 * unit * _COLOR_STEP for unit in (1, 1 / 255, 257)
    )
