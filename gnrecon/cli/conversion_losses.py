"""What a conversion loses: compares a mesh or cloud with what was read back from its file, for ``gnrecon convert``."""

from __future__ import annotations

import numpy as np

from gnrecon.geometry.arrays import Float, Values
from gnrecon.geometry.colors import as_bytes
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.runtime.errors import OutputError


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
