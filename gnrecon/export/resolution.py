"""How fine to mesh: the cells for a given edge length, and the distance of a mesh's faces from its field.

Vertices lie on the zero level, faces only near it. The chord error of a point on a face is |f| / |grad f| there, which
is its distance from the zero level to first order. It is measured where it is greatest: at the centres of faces and the
midpoints of edges. The reported figure is the 99.9th percentile, because at single points, where a field folds, the
first order means nothing. Near a smooth surface it falls with the square of the cell, from which the resolution of the
next attempt follows.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass

import numpy as np

from gnrecon.export.export_parameters import ExportParameters, ResolutionParameters
from gnrecon.export.project import SignedDistance, face_sample_points, project, sdf_and_gradient, side_lengths
from gnrecon.geometry.arrays import Float, Int
from gnrecon.geometry.mesh import Mesh
from gnrecon.runtime.errors import UsageError


@dataclass(frozen=True)
class Fineness:
    """Resolution, edge length and chord error of a mesh.

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
        """One sentence for the user."""
        return (
            f"{self.resolution} cells along the box: the mean edge is {self.edge_length:.3g} units, and 99.9 % of "
            f"face centres and edge midpoints lie within {self.chord_error:.3g} of the fitted surface."
        )

    def as_dict(self) -> dict[str, int | float]:
        """All figures by name, ready for JSON."""
        return asdict(self)


def cells_for_sheet(longest: float, thickness: float, *, cells_through: float = 2.0) -> int:
    """Return the cells along a box that resolve a sheet: with fewer through it, its two sides meet in places."""
    return math.ceil(cells_through * longest / thickness)


def cells_for_edges(
    length: float, bounds: Float, *, parameters: ResolutionParameters = ExportParameters.resolution
) -> int:
    """Return the cells along the longest side of a box, of shape (2, 3), with which edges have a mean length.

    Raises
    ------
    UsageError
        When that needs fewer than 16 or more than 4096 cells.
    """
    longest = float(np.ptp(bounds, axis=0).max())
    cells = round(parameters.mean_edge_cells * longest / length)
    if parameters.least_cells <= cells <= parameters.most_cells:
        return cells
    counts = (parameters.most_cells, parameters.least_cells)
    shortest, widest = (parameters.mean_edge_cells * longest / count for count in counts)
    raise UsageError(
        f"Edges of length {length:g} would need {cells} cells along the box, but {parameters.least_cells} to "
        f"{parameters.most_cells} are possible. Choose a length from {_rounded(shortest, math.ceil)} to "
        f"{_rounded(widest, math.floor)}."
    )


def _rounded(number: float, towards: Callable[[float], int]) -> str:
    """Three digits of a positive number, rounded inward so that the result is a possible length too."""
    digit = 10.0 ** (math.floor(math.log10(number)) - 2)
    return f"{towards(number / digit) * digit:.3g}"


def measure_fineness(
    mesh: Mesh,
    field: SignedDistance,
    resolution: int,
    bounds: Float,
    *,
    parameters: ResolutionParameters = ExportParameters.resolution,
) -> Fineness:
    """Return how fine a projected mesh is that was extracted with `resolution` from `bounds`, of shape (2, 3)."""
    cell = float(np.ptp(bounds, axis=0).max()) / resolution
    edge = float(side_lengths(mesh).mean(dtype=np.float64))
    return Fineness(resolution, edge, chord_error(mesh, field, bounds, cell, parameters=parameters))


def chord_error(
    mesh: Mesh,
    field: SignedDistance,
    bounds: Float,
    cell: float,
    *,
    parameters: ResolutionParameters = ExportParameters.resolution,
) -> float:
    """Return the distance from the zero level, in file units, below which 99.9 % of a mesh's points lie.

    The points are the centres and edge midpoints of at most 5,000 faces, spread evenly over the list of faces. Faces
    at the border of the box do not count, because the caps there are not part of the zero level; the error is 0 where
    there are no others.

    Parameters
    ----------
    mesh : Mesh
    field : SignedDistance
    bounds : array of shape (2, 3), file units
        The box in which the mesh was extracted.
    cell : float, file units
    parameters : ResolutionParameters
    """
    corners = mesh.vertices[_sampled_faces(mesh.faces, parameters.error_faces)]
    inner = ((corners > bounds[0] + cell) & (corners < bounds[1] - cell)).all(axis=(1, 2))
    corners = corners[inner]
    if not len(corners):
        return 0.0
    # First order: |f| / |grad f|. A vanishing gradient gives a large error, which is right: nothing is known there.
    points = face_sample_points(corners)
    values, gradients = sdf_and_gradient(field, points)
    distances = np.abs(values) / np.maximum(np.linalg.norm(gradients, axis=1), np.finfo(np.float64).tiny)
    return float(np.quantile(distances, parameters.error_quantile, method="higher"))


def projected_chord_error(
    mesh: Mesh,
    field: SignedDistance,
    resolution: int,
    bounds: Float,
    *,
    parameters: ResolutionParameters = ExportParameters.resolution,
) -> float:
    """Return the chord error that the mesh will have once it is projected; only the sampled faces are projected."""
    used, inverse = np.unique(_sampled_faces(mesh.faces, parameters.error_faces), return_inverse=True)
    # Two steps, as for the whole mesh.
    part = project(Mesh(mesh.vertices[used], inverse.reshape(-1, 3)), field, steps=2)
    return measure_fineness(part, field, resolution, bounds, parameters=parameters).chord_error


def _sampled_faces(faces: Int, most: int) -> Int:
    """At most so many faces, spread evenly over the list."""
    return faces[:: max(1, -(-len(faces) // most))]


def refined_resolution(resolution: int, error: float, wanted: float, *, spare: float = 1.1) -> int:
    """Return the resolution at which a chord error is expected to be below the one that is wanted.

    `spare` times more cells than the square law asks for keep a third attempt from being needed. That law holds once
    cells are small compared with the features, so that the factor is kept from 1.2 to 3.
    """
    # The chord error falls with the square of the cell.
    factor = spare * math.sqrt(error / wanted)
    return math.ceil(resolution * min(max(factor, 1.2), 3.0))
