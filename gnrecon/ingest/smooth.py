"""Smoothing of a noisy cloud by moving least squares: each point moves onto a quadric fitted to its neighbours.

After Alexa et al., *Computing and Rendering Point Set Surfaces* (2003): the surface around a point is a height over the
plane across the mean normal, here the quadric that fits the neighbours within a width best, with weights
(1 - (r / width)^2)^4 that fall smoothly to zero (Guennebaud and Gross 2007). The point moves along that normal to the
quadric's height, and the quadric's slope gives the new normal. A quadric follows curvature, so round shapes do not
shrink. Neighbours that face the other way, as across a thin wall, are ignored. It is implemented here because the
projections of pymeshlab (2025.7) crash the process.
"""

from __future__ import annotations

import numpy as np

from gnrecon.geometry.arrays import Float
from gnrecon.geometry.local_pca import quadric_terms
from gnrecon.ingest.ingest_parameters import SmoothingParameters
from gnrecon.ingest.point_spacing import neighbour_spacing
from gnrecon.runtime.chunks import slices


def smooth_points(
    points: Float, normals: Float, width: float, *, parameters: SmoothingParameters = SmoothingParameters()
) -> tuple[Float, Float]:
    """Return smoothed positions and their normals, both of shape (N, 3).

    Parameters
    ----------
    points : array of shape (N, 3), centred, distinct
    normals : array of shape (N, 3), of unit length, oriented
    width : radius of the neighbourhoods, in the unit of the points
    parameters : tuning constants
    """
    from scipy.spatial import cKDTree

    tree = cKDTree(points)
    least = parameters.least_neighbours
    # No more than all points, before it is squared.
    spacings = min(width / neighbour_spacing(points), len(points)) if len(points) > least else 1.0
    expected = np.pi * spacings**2
    count = int(min(parameters.neighbour_surplus * expected + least, parameters.most_neighbours, len(points)))
    moved, turned = points.copy(), normals.copy()
    step = max(1, parameters.chunk_values // (6 * count))  # a quadric has 6 terms
    for rows in slices(len(points), step):
        distances, neighbours = tree.query(points[rows], count, distance_upper_bound=width)
        near = np.minimum(neighbours, len(points) - 1).reshape(-1, count)
        weights = _weights(distances.reshape(-1, count), width) * _facing(normals[near], normals[rows])
        moved[rows], turned[rows] = _projected(points[rows], points[near], normals[near], weights, width, parameters)
    untouched = (moved == points).all(axis=1)
    turned[untouched] = normals[untouched]
    return moved, turned


def _weights(distances: Float, width: float) -> Float:
    """Return the weights of neighbours, of shape (G, k); missing ones have infinite distances.

    Where the k-th neighbour is within the width, its distance replaces the width, so that the weights still fall to 0.
    """
    reach = np.where(np.isfinite(distances[:, -1:]), distances[:, -1:], width)
    with np.errstate(invalid="ignore"):
        weights: Float = np.where(np.isfinite(distances), np.maximum(1 - (distances / reach) ** 2, 0) ** 4, 0.0)
    return weights


def _facing(around: Float, own: Float) -> Float:
    """Return 1 for neighbours that face the same way as the point and 0 for others, of shape (G, k)."""
    facing: Float = (np.einsum("gki,gi->gk", around, own) > 0).astype(np.float64)
    return facing


def _projected(
    points: Float, around: Float, normals: Float, weights: Float, width: float, parameters: SmoothingParameters
) -> tuple[Float, Float]:
    """Return points, of shape (G, 3), moved to the quadrics of their neighbours, (G, k, 3), and their new normals."""
    axes = _axes(np.einsum("gk,gki->gi", weights, normals))
    local = np.einsum("gki,gai->gka", around - points[:, None], axes) / width
    u, v, height = np.moveaxis(local, 2, 0)
    columns = quadric_terms(u, v)
    weighted = columns * weights[:, :, None]
    system = np.einsum("gkc,gkd->gcd", weighted, columns)
    trace = np.trace(system, axis1=1, axis2=2)[:, None, None]
    system += parameters.ridge * trace * np.eye(6) + np.finfo(float).tiny * np.eye(6)
    quadric = np.linalg.solve(system, np.einsum("gkc,gk->gc", weighted, height)[:, :, None])[:, :, 0]
    enough = ((weights > 0).sum(axis=1) >= parameters.least_neighbours) & (
        np.abs(quadric[:, 0]) < parameters.most_move_widths
    )
    shift = np.where(enough, quadric[:, 0] * width, 0.0)
    slopes = np.column_stack([-quadric[:, 1:3], np.ones(len(quadric))])
    turned = np.einsum("ga,gai->gi", slopes / np.linalg.norm(slopes, axis=1, keepdims=True), axes)
    return points + shift[:, None] * axes[:, 2], turned


def _axes(normals: Float) -> Float:
    """Return right-handed axes, of shape (G, 3, 3), whose last rows are the normals, scaled to unit length."""
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    third = np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0)
    third[lengths[:, 0] == 0] = [0.0, 0.0, 1.0]
    least = np.eye(3)[np.abs(third).argmin(axis=1)]
    first = np.cross(least, third)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    axes: Float = np.stack([first, np.cross(third, first), third], axis=1)
    return axes
