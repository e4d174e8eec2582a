"""Smoothing a noisy cloud by moving least squares: each point moves onto a quadric fitted to its surroundings.

After Alexa et al., *Computing and Rendering Point Set Surfaces* (2003): the surface about a point is a height over the
plane across its mean normal, here the quadric that fits the neighbours within a width best, with weights
(1 - (r / width)^2)^4 that fall smoothly to zero (Guennebaud and Gross 2007). The point moves along that normal to the
quadric's height, whose slope gives its new normal. A quadric follows curvature, so that round shapes do not shrink.
Neighbours that face the other way, as across a thin wall, do not count. It is written here because pymeshlab's
projections (2025.7) end the process.
"""

from __future__ import annotations

import numpy as np

from gnrecon.geometry.arrays import Float
from gnrecon.ingest.noise import neighbour_spacing
from gnrecon.runtime.chunks import slices

_LEAST = 9
"""Neighbours, the point itself included, that a quadric needs; points with fewer stay where they are."""

_MOST = 512
_SURPLUS = 2  # times the neighbours that are expected within the width, for regions that are denser
_VALUES = 4_000_000
_RIDGE = 1e-9
_FARTHEST = 0.5
"""Of the width, beyond which a point would not move but jump."""


def smooth_points(points: Float, normals: Float, width: float) -> tuple[Float, Float]:
    """Return smoother positions and their normals, both of shape (N, 3).

    Parameters
    ----------
    points : array of shape (N, 3), centred, distinct
    normals : array of shape (N, 3), of unit length, oriented
    width : radius of the surroundings, in the unit of the points
    """
    from scipy.spatial import cKDTree

    tree = cKDTree(points)
    expected = np.pi * (width / neighbour_spacing(points)) ** 2 if len(points) > _LEAST else 1.0
    count = int(min(_SURPLUS * expected + _LEAST, _MOST, len(points)))
    moved, turned = points.copy(), normals.copy()
    step = max(1, _VALUES // (6 * count))
    for rows in slices(len(points), step):
        distances, neighbours = tree.query(points[rows], count, distance_upper_bound=width)
        near = np.minimum(neighbours, len(points) - 1).reshape(-1, count)
        weights = _weights(distances.reshape(-1, count), width) * _facing(normals[near], normals[rows])
        moved[rows], turned[rows] = _projected(points[rows], points[near], normals[near], weights, width)
    untouched = (moved == points).all(axis=1)
    turned[untouched] = normals[untouched]
    return moved, turned


def _weights(distances: Float, width: float) -> Float:
    """Weights of neighbours, of shape (G, k); missing ones are infinitely far, and the farthest may cut the width."""
    reach = np.where(np.isfinite(distances[:, -1:]), distances[:, -1:], width)
    with np.errstate(invalid="ignore"):
        weights: Float = np.where(np.isfinite(distances), np.maximum(1 - (distances / reach) ** 2, 0) ** 4, 0.0)
    return weights


def _facing(around: Float, own: Float) -> Float:
    facing: Float = (np.einsum("gki,gi->gk", around, own) > 0).astype(np.float64)
    return facing


def _projected(points: Float, around: Float, normals: Float, weights: Float, width: float) -> tuple[Float, Float]:
    """Points of shape (G, 3) on the quadrics of their neighbours, of shape (G, k, 3), and the quadrics' normals."""
    axes = _axes(np.einsum("gk,gki->gi", weights, normals))
    local = np.einsum("gki,gai->gka", around - points[:, None], axes) / width
    u, v, height = np.moveaxis(local, 2, 0)
    columns = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=2)
    weighted = columns * weights[:, :, None]
    system = np.einsum("gkc,gkd->gcd", weighted, columns)
    system += _RIDGE * np.trace(system, axis1=1, axis2=2)[:, None, None] * np.eye(6) + np.finfo(float).tiny * np.eye(6)
    quadric = np.linalg.solve(system, np.einsum("gkc,gk->gc", weighted, height)[:, :, None])[:, :, 0]
    enough = ((weights > 0).sum(axis=1) >= _LEAST) & (np.abs(quadric[:, 0]) < _FARTHEST)
    shift = np.where(enough, quadric[:, 0] * width, 0.0)
    slopes = np.column_stack([-quadric[:, 1:3], np.ones(len(quadric))])
    turned = np.einsum("ga,gai->gi", slopes / np.linalg.norm(slopes, axis=1, keepdims=True), axes)
    return points + shift[:, None] * axes[:, 2], turned


def _axes(normals: Float) -> Float:
    """Right-handed axes, of shape (G, 3, 3), whose last rows are the normals, scaled to unit length."""
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    third = np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0)
    third[lengths[:, 0] == 0] = [0.0, 0.0, 1.0]
    least = np.eye(3)[np.abs(third).argmin(axis=1)]
    first = np.cross(least, third)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    axes: Float = np.stack([first, np.cross(third, first), third], axis=1)
    return axes
