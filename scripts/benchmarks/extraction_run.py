"""The parts of the extraction benchmark that run in processes of their own: fit, extraction, and the whole grid."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.harness.measurement import Stopwatch
from gnrecon.export import SignedDistance, extract, project
from gnrecon.export.lattice import Lattice
from gnrecon.export.sparse_grid import narrow_band
from gnrecon.fit import FitOptions, NeuralSDF, fit
from gnrecon.geometry.arrays import Float, Int
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import Frame
from gnrecon.ingest import prepare
from gnrecon.io import read_cloud


def fit_scan(scan: str, model: str, *, steps: int = 4) -> dict[str, Any]:
    """Fit a scan by one wide layer in some steps after its start, and save the field; its features are all global."""
    samples, _ = prepare(read_cloud(Path(scan)))
    sdf, solution = fit(samples, FitOptions(steps=steps))
    sdf.save(model)
    return {"points": len(samples), "status": solution.status}


class Counting:
    """A field that counts the points at which its values and gradients are evaluated."""

    def __init__(self, field: NeuralSDF) -> None:
        self._field = field
        self.values = self.gradients = 0

    @property
    def frame(self) -> Frame:
        """The field's."""
        return self._field.frame

    @property
    def bounds(self) -> Float:
        """The field's."""
        return self._field.bounds

    def sdf(self, points: Float) -> Float:
        """Return values, of shape (N,), at points, of shape (N, 3)."""
        self.values += len(points)
        return self._field.sdf(points)

    def sdf_around(self, centers: Float, offsets: Float) -> Float:
        """Return values at all `offsets` from each centre."""
        self.values += len(centers) * len(offsets)
        return self._field.sdf_around(centers, offsets)

    def gradient(self, points: Float) -> Float:
        """Return gradients, of shape (N, 3), at points, of shape (N, 3)."""
        self.gradients += len(points)
        return self._field.gradient(points)


def measure_extraction(model: str, resolution: int) -> dict[str, Any]:
    """Extract a saved field in single precision, project in its own, and return the figures.

    The whole box is searched, without a hint where the surface is. A gradient counts as an evaluation, as a value does.
    """
    sdf = NeuralSDF.load(model)
    field, exact = Counting(sdf.single()), Counting(sdf)
    nodes = int(np.prod(Lattice.over(sdf, resolution, None, 1).cells + 1))
    with Stopwatch() as extraction:
        mesh = extract(field, resolution=resolution)
    with Stopwatch() as projection:
        mesh = project(mesh, exact, steps=2)
    evaluations = field.values + field.gradients
    return {
        "vertices": len(mesh.vertices),
        "faces": len(mesh.faces),
        "nodes": nodes,
        "evaluations": evaluations,
        "gradients": field.gradients,
        "share": evaluations / nodes,
        "project_evaluations": exact.values + exact.gradients,
        "seconds": extraction.seconds,
        "cpu_seconds": extraction.cpu_seconds,
        "project_seconds": projection.seconds,
        "project_cpu_seconds": projection.cpu_seconds,
    }


def measure_whole_grid(model: str, resolution: int) -> dict[str, Any]:
    """Compare both surfaces of a saved field, in its own precision.

    In single precision the last digits depend on which points are evaluated together, and cancelling weights enlarge
    them to some hundredths of a cell.
    """
    return compare(NeuralSDF.load(model), resolution)


def compare(field: SignedDistance, resolution: int, *, tolerance_cells: float = 1e-4) -> dict[str, Any]:
    """Extract a field both ways and return counts, whether they agree, and how far apart vertices are, in cells.

    Vertices within `tolerance_cells` are the same: scikit-image returns float32.
    """
    ours = extract(field, resolution=resolution)
    lattice = Lattice.over(field, resolution, None, 65536)
    vertices, faces = whole_surface(lattice)
    same, farthest = same_surface(
        ours, lattice.world(vertices), faces, tolerance_cells * lattice.cell * field.frame.scale
    )
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
    """Return vertices, in lattice coordinates, and faces from all nodes of a lattice."""
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
    """Return whether a mesh has the given vertices and faces in any order, and the largest distance of two vertices."""
    from scipy.spatial import cKDTree

    distance, partner = cKDTree(ours.vertices).query(vertices)
    farthest = float(distance.max())
    paired = len(ours.vertices) == len(vertices) == len(np.unique(partner)) and farthest <= tolerance
    return paired and np.array_equal(_ordered(ours.faces), _ordered(partner[faces])), farthest


def _ordered(faces: Int) -> Int:
    """Return faces, each from its lowest vertex on, in lexicographic order."""
    turned = np.take_along_axis(faces, (faces.argmin(axis=1)[:, None] + np.arange(3)) % 3, axis=1)
    return turned[np.lexsort(turned.T)]
