"""STL, triangles without shared vertices: read by trimesh, with equal corners merged; written binary (float32).

Coordinates may be relative to an origin that the header states, see `gnrecon.io.origin`.
"""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np

from gnrecon.geometry.mesh import Mesh
from gnrecon.io.contents import Contents
from gnrecon.io.origin import float32_origin, parse_origin, stl_header
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
    """Write binary STL; coordinates are rounded to float32, the only precision that the format has.

    They are relative to an origin, stated in the header, where rounding would otherwise merge different vertices.
    """
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
