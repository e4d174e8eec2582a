"""Where a field is sharp: creases between faces, and the points on them.

Newton's method along the gradient cannot find an edge or a corner of a field, because there the gradient jumps. But the
surface on either side is smooth. From points on both sides, the tangent planes are taken, and the point that fits all
of them best is the crease's: the least-squares intersection of the extended marching cubes (Kobbelt, Botsch, Schwanecke
and Seidel, 2001) and of dual contouring (Ju, Losasso, Schaefer and Warren, 2002). Directions in which the planes say
nothing are left alone: two planes move a point only across their line. Then the points on both sides are drawn nearer
to it and the planes taken again, so that creases between curved surfaces are met too.
"""

from __future__ import annotations

import numpy as np

from gnrecon.export.protocol import SignedDistance
from gnrecon.export.surface import EdgeTable, unit
from gnrecon.geometry.arrays import Float, Int, Mask

NEARER = 0.3
"""Share of the way to the crease that is left between two rounds."""

ROUNDS = 3


def feet(points: Float, field: SignedDistance, steps: int = 2) -> tuple[Float, Float]:
    """Points of shape (N, 3) brought to the zero level by Newton steps, and the field's unit gradients there."""
    gradient = field.gradient(points)
    for _ in range(steps):
        squares = np.maximum(np.einsum("ij,ij->i", gradient, gradient), np.finfo(np.float64).tiny)
        points = points - (field.sdf(points) / squares)[:, None] * gradient
        gradient = field.gradient(points)
    return points, unit(gradient)


def crease_edges(normals: Float, edges: EdgeTable, angle: float) -> Mask:
    """Which edges lie between faces whose normals, of shape (F, 3), differ by more than `angle` degrees."""
    one, other = normals[edges.faces[:, 0]], normals[edges.faces[:, 1]]
    return np.asarray(np.einsum("ij,ij->i", one, other) < np.cos(np.radians(angle)))


def meeting_points(points: Float, owners: Int, sides: Float, field: SignedDistance, angle: float) -> Float:
    """Move points to where the surfaces beside them meet.

    Parameters
    ----------
    points : array of shape (N, 3)
        Near a crease each, file units.
    owners : integer array of shape (S,)
        Which point each of `sides` belongs to.
    sides : array of shape (S, 3)
        Points near the surface on all sides of the crease.
    field : SignedDistance
    angle : float
        Least angle between the sides of a crease in degrees; planes that differ by much less count as one.

    Returns
    -------
    array of shape (N, 3)
    """
    places, normals = feet(sides, field)
    for _ in range(ROUNDS):
        points = points + _least_squares(points, owners, places, normals, angle)
        nearer, new = feet(points[owners] + NEARER * (places - points[owners]), field)
        # Past the crease the normal is the other side's: then the plane from farther away is the better one.
        same = np.einsum("ij,ij->i", normals, new) > np.cos(np.radians(angle) / 2)
        places = np.where(same[:, None], nearer, places)
        normals = np.where(same[:, None], new, normals)
    return points + _least_squares(points, owners, places, normals, angle)


def _least_squares(points: Float, owners: Int, places: Float, normals: Float, angle: float) -> Float:
    """Shortest steps, of shape (N, 3), to the points that fit the planes through `places` best."""
    matrix = np.zeros((len(points), 3, 3))
    vector = np.zeros((len(points), 3))
    np.add.at(matrix, owners, normals[:, :, None] * normals[:, None, :])
    heights = np.einsum("ij,ij->i", normals, places - points[owners])
    np.add.at(vector, owners, normals * heights[:, None])
    values, axes = np.linalg.eigh(matrix)
    # Two unit normals at this angle have eigenvalues in the ratio tan(angle / 2)^2.
    known = values > 0.25 * np.tan(np.radians(angle) / 2) ** 2 * values[:, 2:]
    inverse = np.divide(1.0, values, out=np.zeros_like(values), where=known & (values > 0))
    steps: Float = np.einsum("nij,nj,nkj,nk->ni", axes, inverse, axes, vector, optimize=True)
    return steps
