"""The origin of an STL file's coordinates, for meshes whose coordinates are too large for float32.

A float32 has about seven digits, so a coordinate such as 4,123,456.789 is rounded to a quarter: faces flip, and short
edges collapse, because STL joins corners by their positions. A mesh whose vertices would move by more than a thousandth
of its edges is therefore written relative to an origin near its middle, a multiple of a power of ten, which the file's
header states: ``STL, origin 512300 4123400 120``.
"""

from __future__ import annotations

import re

import numpy as np

from gnrecon.geometry.arrays import Float
from gnrecon.geometry.mesh import Mesh


def float32_origin(mesh: Mesh, *, tolerance_edges: float = 1e-3) -> Float | None:
    """Return the origin, of shape (3,), relative to which a mesh must be written in float32; None where none is needed.

    Parameters
    ----------
    mesh : in file units
    tolerance_edges : rounding that needs no origin, in median edges: far below what shows in a rendered surface
    """
    moved = float32_rounding(mesh.vertices)
    if moved == 0 or moved <= tolerance_edges * _median_edge(mesh):
        return None
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    size = float(np.linalg.norm(high - low))
    step = 10.0 ** np.floor(np.log10(size)) if size > 0 else 1.0
    # Through text, so that exactly the origin in the header is subtracted.
    return np.array([float(f"{number:.15g}") for number in np.rint((low + high) / 2 / step) * step])


def float32_rounding(points: Float) -> float:
    """Return the greatest change of coordinates, of shape (N, 3), by rounding to float32; infinite beyond its range."""
    with np.errstate(over="ignore"):
        return float(np.abs(points - points.astype(np.float32)).max(initial=0.0))


def format_origin(origin: Float) -> str:
    """Return an origin, of shape (3,), as text."""
    return " ".join(f"{number:.15g}" for number in origin + 0.0)


def origin_remark(origin: Float) -> str:
    """Return a sentence on what the coordinates of a written file are relative to."""
    return (
        f"STL stores float32, which has too few digits for these coordinates, so they are relative to the origin "
        f"{format_origin(origin)}. The file's header states it; gnrecon adds it on reading, most programs do not. "
        f"PLY and OBJ keep the coordinates exactly."
    )


def stl_header(origin: Float | None) -> bytes:
    """Return the header of a binary STL whose coordinates are relative to an origin."""
    text = "binary STL" if origin is None else f"STL, origin {format_origin(origin)}"
    return text.encode().ljust(80)  # the size of the header, by the format


def parse_origin(header: bytes) -> Float:
    """Return the origin stated by the 80 bytes of an STL's header, of shape (3,); zero where it states none."""
    match = re.fullmatch(rb"STL, origin (\S+) (\S+) (\S+) *", header)
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
