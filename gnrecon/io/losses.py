"""What a written file no longer says of the mesh or cloud that it was made from, found by reading it back."""

from __future__ import annotations

import numpy as np

from gnrecon.geometry.arrays import Float, Values
from gnrecon.geometry.colors import as_bytes
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.runtime.errors import OutputError

_DIGITS = 4 * np.finfo(np.float64).eps
"""Rounding that the same numbers in another frame have anyway, as a share of the largest coordinate."""

_COLOR_STEP = 1e-3
"""Rounding of colours, as a share of full brightness, that is no more than the digits of a text file."""


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
