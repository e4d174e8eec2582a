"""How fine to extract: the cells for edges of a wanted length, and how far a mesh's faces lie from its field.

Vertices lie on the zero level, faces only near it. The chord error of a point on a face is |f| / |grad f| there, which
is its distance from the zero level to first order. It is measured where it is greatest: at the centres of faces and the
midpoints of edges. The figure given is the value that all but one in a thousand of these points stay below, because at
single points, where a field folds, the first order says nothing. Near a smooth surface it falls with the square of the
cell, which tells how fine the next attempt must be.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass

import numpy as np

from gnrecon.export.project import SignedDistance, face_sample_points, project, side_lengths
from gnrecon.geometry.arrays import Float, Int
from gnrecon.geometry.mesh import Mesh
from gnrecon.runtime.errors import UsageError

MEAN_EDGE = 0.97
"""Mean length of marching cubes' edges, in cells."""

LEAST_CELLS, MOST_CELLS = 16, 4096
"""Cells along the longest side that an edge length may ask for."""

MOST_REFINED = 1024
"""Cells along the longest side up to which a mesh is refined for its chord error."""

QUANTILE = 0.999
"""Share of the points whose chord error is below the figure that is given."""

_FACES = 5_000
_SPARE = 1.1


@dataclass(frozen=True)
class Fineness:
    """How fine a mesh is.

    Parameters
    ----------
    resolution : int
        Cells along the longest side of the box, of the extraction.
    edge_length : float, file units
        Mean length of the edges.
    chord_error : float, file units
        Distance from the zero level that 99.9 % of face centres and edge midpoints stay below.
    """

    resolution: int
    edge_length: float
    chord_error: float

    def describe(self) -> str:
        """Say it in a sentence."""
        return (
            f"With {self.resolution} cells along the box, edges are {self.edge_length:.3g} units long on average, and "
            f"99.9 % of face centres and edge midpoints lie within {self.chord_error:.3g} of the field's surface."
        )

    def as_dict(self) -> dict[str, int | float]:
        """All figures by name, ready for JSON."""
        return asdict(self)


def cells_for_edges(length: float, bounds: Float) -> int:
    """Return the cells along the longest side of a box, of shape (2, 3), with which edges have a mean length.

    Raises
    ------
    UsageError
        When that needs fewer than 16 or more than 4096 cells.
    """
    longest = float(np.ptp(bounds, axis=0).max())
    cells = round(MEAN_EDGE * longest / length)
    if LEAST_CELLS <= cells <= MOST_CELLS:
        return cells
    shortest, widest = (MEAN_EDGE * longest / count for count in (MOST_CELLS, LEAST_CELLS))
    raise UsageError(
        f"Edges of length {length:g} would need {cells} cells along the {longest:.4g} units of the box, but only "
        f"{LEAST_CELLS} to {MOST_CELLS} are possible, which is a length from {_rounded(shortest, math.ceil)} to "
        f"{_rounded(widest, math.floor)}."
    )


def _rounded(number: float, towards: Callable[[float], int]) -> str:
    """Three digits of a positive number, so rounded that the result is a possible length too."""
    digit = 10.0 ** (math.floor(math.log10(number)) - 2)
    return f"{towards(number / digit) * digit:.3g}"


def measure_fineness(mesh: Mesh, field: SignedDistance, resolution: int, bounds: Float) -> Fineness:
    """Return how fine a projected mesh, extracted with `resolution` from `bounds`, of shape (2, 3), is."""
    cell = float(np.ptp(bounds, axis=0).max()) / resolution
    edge = float(side_lengths(mesh).mean(dtype=np.float64))
    return Fineness(resolution, edge, chord_error(mesh, field, bounds, cell))


def chord_error(mesh: Mesh, field: SignedDistance, bounds: Float, cell: float) -> float:
    """Return the distance from the zero level, in file units, below which 99.9 % of a mesh's points lie.

    The points are the centres and edge midpoints of at most 5,000 faces, spread evenly over the list of faces. Faces
    at the border of the box do not count, because what closes the surface there does not belong to the zero level; the
    error is 0 where there are no others.

    Parameters
    ----------
    mesh : Mesh
    field : SignedDistance
    bounds : array of shape (2, 3), file units
        The box in which the mesh was extracted.
    cell : float, file units
    """
    corners = mesh.vertices[_sampled_faces(mesh.faces)]
    inner = ((corners > bounds[0] + cell) & (corners < bounds[1] - cell)).all(axis=(1, 2))
    corners = corners[inner]
    if not len(corners):
        return 0.0
    points = face_sample_points(corners)
    slopes = np.linalg.norm(field.gradient(points), axis=1)
    distances = np.abs(field.sdf(points)) / np.maximum(slopes, np.finfo(np.float64).tiny)
    return float(np.quantile(distances, QUANTILE, method="higher"))


def projected_chord_error(mesh: Mesh, field: SignedDistance, resolution: int, bounds: Float) -> float:
    """Return what the chord error will be once the mesh is projected, projecting only the faces that are looked at."""
    used, inverse = np.unique(_sampled_faces(mesh.faces), return_inverse=True)
    part = Mesh(mesh.vertices[used], inverse.reshape(-1, 3))
    return measure_fineness(project(part, field, steps=2), field, resolution, bounds).chord_error


def _sampled_faces(faces: Int) -> Int:
    """At most so many faces as are looked at, spread evenly over the list."""
    return faces[:: max(1, -(-len(faces) // _FACES))]


def refined_resolution(resolution: int, error: float, wanted: float) -> int:
    """Return the resolution at which a chord error is expected to be below the one that is wanted."""
    factor = _SPARE * math.sqrt(error / wanted)
    # The square law holds once the cells are small beside the features: far leaps are not to be trusted.
    return math.ceil(resolution * min(max(factor, 1.2), 3.0))
