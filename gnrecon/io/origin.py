"""The origin that an STL's coordinates are relative to, where float32 has too few digits for them as they are.

A float32 has about seven digits. Of a coordinate such as 4,123,456.789 they reach to a quarter: faces turn over, and
short edges collapse, because STL joins corners by their positions. A mesh whose vertices would move by more than a
thousandth of its edges, and no other, is written relative to an origin near its middle, a multiple of a power of ten,
which the file's header names: ``STL, origin 512300 4123400 120``.
"""

from __future__ import annotations

import re

import numpy as np

from gnrecon.geometry.arrays import Float
from gnrecon.geometry.mesh import Mesh

HEADER = 80
"""Bytes of an STL's header."""

COARSE = 1e-3
"""Rounding, as a share of the median edge, from which on it shows."""

_NAMED = re.compile(rb"STL, origin (\S+) (\S+) (\S+) *")


def far_origin(mesh: Mesh) -> Float | None:
    """Return the origin, of shape (3,), relative to which a mesh must be written in float32; None for its own.

    It is needed where rounding would move vertices by more than a thousandth of the median edge.
    """
    moved = rounding(mesh.vertices)
    if moved == 0 or moved <= COARSE * _median_edge(mesh):
        return None
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    size = float(np.linalg.norm(high - low))
    step = 10.0 ** np.floor(np.log10(size)) if size > 0 else 1.0
    # Through text, so that what is subtracted is what the header says.
    return np.array([float(f"{number:.15g}") for number in np.rint((low + high) / 2 / step) * step])


def rounding(points: Float) -> float:
    """Return how far rounding to float32 moves coordinates, of shape (N, 3), at most; infinite beyond its range."""
    with np.errstate(over="ignore"):
        return float(np.abs(points - points.astype(np.float32)).max(initial=0.0))


def in_words(origin: Float) -> str:
    """Return an origin, of shape (3,), as text."""
    return " ".join(f"{number:.15g}" for number in origin + 0.0)


def told(origin: Float) -> str:
    """Say to the one who gets the file what its coordinates are relative to."""
    return (
        f"Float32, as STL stores it, has too few digits for these coordinates, so the file's are relative to the "
        f"origin {in_words(origin)}, which its header names; gnrecon adds it on reading, most programs do not. "
        f"PLY and OBJ keep the coordinates exactly."
    )


def header(origin: Float | None) -> bytes:
    """Return the header of a binary STL whose coordinates are relative to an origin."""
    text = "binary STL" if origin is None else f"STL, origin {in_words(origin)}"
    return text.encode().ljust(HEADER)


def origin_in(start: bytes) -> Float:
    """Return the origin that the first bytes of an STL name, of shape (3,); zero where they name none."""
    match = _NAMED.fullmatch(start[:HEADER])
    try:
        origin = np.array([float(number) for number in match.groups()]) if match else np.zeros(3)
    except ValueError:
        return np.zeros(3)
    return origin if np.isfinite(origin).all() else np.zeros(3)


def _median_edge(mesh: Mesh) -> float:
    ends = mesh.faces[:, [0, 1, 2, 0]]
    return float(
        np.median([np.linalg.norm(mesh.vertices[ends[:, i]] - mesh.vertices[ends[:, i + 1]], axis=1) for i in range(3)])
    )
