"""STL, triangles without shared vertices: read by trimesh, with equal corners merged; written binary (float32).

A float32 has about seven digits, so a coordinate such as 4,123,456.789 is rounded to a quarter: faces flip, and short
edges collapse, because STL joins corners by their positions. A mesh whose vertices would move by more than a thousandth
of its edges is therefore written relative to an origin near its middle, a multiple of a power of ten, which the file's
header states: ``STL, origin 512300 4123400 120``.
"""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import numpy as np

from gnrecon.geometry.arrays import Float
from gnrecon.geometry.mesh import Mesh
from gnrecon.io.contents import Contents
from gnrecon.runtime.errors import InputError
from gnrecon.runtime.logs import unprinted_log


def read_stl(path: Path) -> Contents:
    """Read a binary or text STL; corners of exactly equal position become one vertex, in order of appearance."""
    from trimesh.exchange.stl import HeaderError, load_stl

    try:
        with path.open("rb") as file, warnings.catch_warnings():
            warnings.simplefilter("error", DeprecationWarning)  # how numpy reports words that are not numbers
            origin = parse_origin(file.read(80))
            file.seek(0)
            # trimesh logs what it raises, with a trace, and Python prints the log of a library to stderr.
            with unprinted_log("trimesh"):
                loaded = load_stl(file)
    except (HeaderError, DeprecationWarning, ValueError):
        raise InputError("the file is neither a complete binary STL nor a well-formed text STL.") from None
    solids = [loaded] if "vertices" in loaded else list(loaded["geometry"].values())
    if not solids:
        raise InputError("the file holds no complete STL solid: it is empty, cut short, or of another format.")
    corners = np.concatenate([np.asarray(solid["vertices"], np.float64) for solid in solids])
    # np.unique sorts the positions; their ranks by first appearance restore the order.
    _, first, which = np.unique(corners, axis=0, return_index=True, return_inverse=True)
    return Contents(origin + corners[np.sort(first)], None, np.argsort(np.argsort(first))[which].reshape(-1, 3))


def write_stl(mesh: Mesh, path: Path) -> None:
    """Write binary STL, relative to an origin where rounding to float32 would merge different vertices."""
    origin = float32_origin(mesh)
    record = np.dtype([("normal", "<f4", (3,)), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    facets = np.zeros(len(mesh.faces), record)
    area = mesh.face_vectors
    lengths = np.maximum(np.linalg.norm(area, axis=1, keepdims=True), np.finfo(np.float64).tiny)
    facets["normal"] = area / lengths
    facets["corners"] = mesh.corners if origin is None else mesh.corners - origin
    with path.open("wb") as file:
        file.write(stl_header(origin))
        # Not `tofile`, which does not notice when the last bytes find the disk full.
        file.write(np.array(len(facets), "<u4").data)
        file.write(facets.data)


def float32_origin(mesh: Mesh, *, tolerance_edges: float = 1e-3) -> Float | None:
    """Return the origin, of shape (3,), relative to which a mesh must be written in float32; None where none is needed.

    Rounding by `tolerance_edges` of the median edge needs none: it is far below what shows in a rendered surface.
    """
    moved = _rounding(mesh.vertices)
    edges = np.linalg.norm(mesh.corners - np.roll(mesh.corners, -1, axis=1), axis=2)
    if moved == 0 or moved <= tolerance_edges * float(np.median(edges)):
        return None
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    size = float(np.linalg.norm(high - low))
    step = 10.0 ** np.floor(np.log10(size)) if size > 0 else 1.0
    # Through text, so that exactly the origin in the header is subtracted.
    return np.array([float(f"{number:.15g}") for number in np.rint((low + high) / 2 / step) * step])


def _rounding(points: Float) -> float:
    """Return the greatest change of coordinates, of shape (N, 3), by rounding to float32; infinite beyond its range."""
    with np.errstate(over="ignore"):
        return float(np.abs(points - points.astype(np.float32)).max(initial=0.0))


def rounding_remark(mesh: Mesh, *, visible_diagonals: float) -> list[str]:
    """Return a sentence on how STL stores coordinates, where rounding is visible, in diagonals of the mesh."""
    if (origin := float32_origin(mesh)) is not None:
        return [origin_remark(origin)]
    moved = _rounding(mesh.vertices)
    if moved <= visible_diagonals * float(np.linalg.norm(np.ptp(mesh.vertices, axis=0))):
        return []
    return [f"STL stores float32: coordinates are rounded by up to {moved:.2g} units; PLY or OBJ keep them exactly."]


def origin_remark(origin: Float) -> str:
    """Return a sentence on what the coordinates of a written file are relative to."""
    return (
        f"STL stores float32, which has too few digits for these coordinates, so they are relative to the origin "
        f"{format_origin(origin)}. The file's header states it; gnrecon adds it on reading, most programs do not. "
        f"PLY and OBJ keep the coordinates exactly."
    )


def format_origin(origin: Float) -> str:
    """Return an origin, of shape (3,), as text."""
    return " ".join(f"{number:.15g}" for number in origin + 0.0)


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
