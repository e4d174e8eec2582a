"""What a reader returns: the points, and whatever else its file stores, before it becomes a cloud or a mesh."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from gnrecon.errors import InputError

Float = npt.NDArray[np.float64]
Int = npt.NDArray[np.int64]
Columns = Mapping[str, npt.NDArray[np.generic]]

_POSITION = (("x", "y", "z"),)
_NORMAL = (("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z"), ("normalx", "normaly", "normalz"))
_COLOR = (
    ("red", "green", "blue", "alpha"),
    ("red", "green", "blue"),
    ("r", "g", "b", "a"),
    ("r", "g", "b"),
    ("diffuse_red", "diffuse_green", "diffuse_blue"),
)


def no_faces() -> Int:
    """Return an empty face array, of shape (0, 3)."""
    return np.empty((0, 3), dtype=np.int64)


@dataclass(frozen=True)
class Contents:
    """Arrays of one file, in its own order.

    Parameters
    ----------
    points : array of shape (N, 3), file units
    normals : array of shape (N, 3), optional, as stored
    faces : integer array of shape (F, 3); empty for a bare cloud
    attributes : mapping of name to array of N rows
    unread : what else the file holds, in words such as ``"texture coordinates"``
    """

    points: Float
    normals: Float | None = None
    faces: Int = field(default_factory=no_faces)
    attributes: Columns = field(default_factory=dict)
    unread: tuple[str, ...] = ()


def _take(columns: dict[str, npt.NDArray[np.generic]], choices: tuple[tuple[str, ...], ...]) -> Columns | None:
    """Remove and return the first complete choice of names (case does not matter), or None."""
    for names in choices:
        spelled = {name.lower(): name for name in columns}
        if all(name in spelled for name in names):
            return {name: columns.pop(spelled[name]) for name in names}
    return None


def from_columns(columns: Columns, faces: Int | None = None) -> Contents:
    """Sort named columns, each of shape (N,), into positions, normals, ``colors`` and other attributes.

    Raises
    ------
    InputError
        When x, y or z is missing.
    """
    rest = dict(columns)
    position = _take(rest, _POSITION)
    if position is None:
        found = ", ".join(columns) if columns else "none"
        raise InputError(f"expected columns named x, y and z, but found {found}.")
    normal = _take(rest, _NORMAL)
    color = _take(rest, _COLOR)
    if color is not None:
        rest["colors"] = np.column_stack(list(color.values()))
    return Contents(
        np.column_stack([values.astype(np.float64) for values in position.values()]),
        None if normal is None else np.column_stack([values.astype(np.float64) for values in normal.values()]),
        no_faces() if faces is None else faces,
        rest,
    )
