"""Marching cubes on the whole grid, and whether the narrow band's surface is the same."""

from __future__ import annotations

from typing import Any

import numpy as np

from gnrecon.export import SignedDistance, extract
from gnrecon.export.lattice import Lattice
from gnrecon.export.sparse_grid import narrow_band
from gnrecon.fit import NeuralSDF
from gnrecon.geometry.arrays import Float, Int
from gnrecon.geometry.mesh import Mesh

TOLERANCE = 1e-4
"""Cells within which vertices are the same: scikit-image returns float32."""


def measure(folder: str, model: str, resolution: int) -> dict[str, Any]:
    """Compare both surfaces of a saved field, in its own precision.

    In single precision the last digits depend on which points are evaluated together, and cancelling weights enlarge
    them to some hundredths of a cell.
    """
    del folder
    return compare(NeuralSDF.load(model), resolution)


def compare(field: SignedDistance, resolution: int) -> dict[str, Any]:
    """Extract a field both ways and return counts, whether they agree, and how far apart vertices are, in cells."""
    ours = extract(field, resolution=resolution)
    lattice = Lattice.over(field, resolution, None, 65536)
    vertices, faces = whole_surface(lattice)
    same, farthest = same_surface(ours, lattice.world(vertices), faces, TOLERANCE * lattice.cell * field.frame.scale)
    return {
        "resolution": resolution,
        "nodes": int(np.prod(lattice.cells + 1)),
        "vertices": len(vertices),
        "faces": len(faces),
        "our_vertices": len(ours.vertices),
        "our_faces": len(ours.faces),
        "same": same,
        "farthest": farthest / (lattice.cell * field.frame.scale),
    }


def whole_surface(lattice: Lattice) -> tuple[Float, Int]:
    """Vertices, in lattice coordinates, and faces from all nodes of a lattice."""
    from skimage import measure as images

    band = narrow_band(lattice)
    values = np.empty(lattice.cells + 1, dtype=np.float32)
    plane = np.stack(np.meshgrid([0], *map(np.arange, values.shape[1:]), indexing="ij"), axis=-1).reshape(-1, 3)
    for i in range(len(values)):
        values[i] = band.clamp(lattice.values(plane + np.array([i, 0, 0]), band.slope)).reshape(values.shape[1:])
    marching_cubes: Any = images.marching_cubes
    vertices, faces, _, _ = marching_cubes(values, 0.0, gradient_direction="descent", method="lewiner")
    return vertices.astype(np.float64), faces.astype(np.int64)


def same_surface(ours: Mesh, vertices: Float, faces: Int, tolerance: float) -> tuple[bool, float]:
    """Whether a mesh has the given vertices and faces in any order, and the greatest distance between two vertices."""
    from scipy.spatial import cKDTree

    distance, partner = cKDTree(ours.vertices).query(vertices)
    farthest = float(distance.max())
    paired = len(ours.vertices) == len(vertices) == len(np.unique(partner)) and farthest <= tolerance
    return paired and np.array_equal(_ordered(ours.faces), _ordered(partner[faces])), farthest


def _ordered(faces: Int) -> Int:
    """Faces, each from its lowest vertex on, in lexicographic order."""
    turned = np.take_along_axis(faces, (faces.argmin(axis=1)[:, None] + np.arange(3)) % 3, axis=1)
    return turned[np.lexsort(turned.T)]
