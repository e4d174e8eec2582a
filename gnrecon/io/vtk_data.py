"""What the two forms of VTK's polydata have in common: names of number types, strips, and what an array means."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from gnrecon.geometry.arrays import Float, Int, Values
from gnrecon.io.contents import Contents, fan, no_faces
from gnrecon.runtime.errors import InputError


def assemble(
    points: Float, faces: Int, arrays: Mapping[str, Values], normals: str | None, unread: list[str]
) -> Contents:
    """Return the contents of a data set.

    Parameters
    ----------
    points : array of shape (N, 3)
    faces : integer array of shape (F, 3)
    arrays : the points' arrays by name, of shape (N,) or (N, C)
    normals : name of the array that holds the normals, if any; else one called ``Normals`` does
    unread : what else the file holds

    Raises
    ------
    InputError
        When an array has another number of rows.
    """
    attributes = dict(arrays)
    for name, values in attributes.items():
        if len(values) != len(points):
            raise InputError(f"{name!r} has {len(values)} values, but there are {len(points)} points.")
    chosen = next((name for name in (normals, "Normals") if name in attributes), None)
    directions = None if chosen is None or attributes[chosen].shape[1:] != (3,) else attributes.pop(chosen)
    # VTK draws an array of bytes as the colours that it holds.
    colors = next((name for name, one in attributes.items() if one.dtype == np.uint8 and _is_color(one)), None)
    if colors is not None:
        attributes = {"colors": attributes.pop(colors), **attributes}
    return Contents(
        points.astype(np.float64),
        None if directions is None else directions.astype(np.float64),
        faces,
        attributes,
        tuple(unread),
    )


def _is_color(values: Values) -> bool:
    return values.ndim == 2 and values.shape[1] in (3, 4)


def triangles(counts: Int, corners: Int, strips: bool) -> Int:
    """Return the triangles, of shape (F, 3), of polygons or of triangle strips.

    Parameters
    ----------
    counts : integer array of shape (P,), corners of each
    corners : integer array of shape (counts.sum(),)
    strips : whether each is a strip, in which every other triangle is turned
    """
    if not strips or not len(counts):
        return fan(counts, corners) if len(counts) else no_faces()
    starts = np.cumsum(counts) - counts
    found = []
    for start, count in zip(starts.tolist(), counts.tolist(), strict=True):
        strip = np.stack([corners[start + k : start + count - 2 + k] for k in range(3)], axis=1)
        strip[1::2] = strip[1::2, [1, 0, 2]]
        found.append(strip)
    return np.concatenate(found)


def split_counts(offsets: Int, corners: Int) -> Int:
    """Return how many corners each polygon has, of shape (P,), from offsets of shape (P + 1,) that begin with 0.

    Raises
    ------
    InputError
        When the offsets do not grow from 0 to the number of corners.
    """
    counts = np.diff(offsets)
    if len(offsets) and (offsets[0] != 0 or offsets[-1] != len(corners) or (counts < 0).any()):
        raise InputError("the offsets of the polygons do not grow from 0 to the number of their corners.")
    return counts
