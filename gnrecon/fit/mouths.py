"""Samples of a face that was continued across the mouth of a bore, by what was seen of the bore's wall.

A face that ends at a bore has a hole there, which looks like a part of the face that nobody saw. But points just behind
the face, on the bore's wall, look to the middle of the hole from all around it, where the thing would be solid if the
face went on.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from gnrecon.geometry.arrays import Float, Mask
from gnrecon.geometry.statistics import widest_gap

WITHIN = 1.5
"""How far points are looked for around a sample, in distances of the nearest one."""

ACROSS = 0.5
"""Most cosine of a wall's normal and the face's."""

OPEN = np.radians(150.0)
"""Widest angle about a sample into which no wall may be, of a mouth."""

MOUTH = 1.6
"""How far from such a sample others of the same face lie in the mouth, too, in distances of the nearest point."""

ALIKE = 0.95
"""Least cosine of the normals of samples of one face."""


def mouths(samples: Float, normals: Float, points: Float, their_normals: Float) -> Mask:
    """Return which samples lie in the mouths of bores, of shape (M,).

    Parameters
    ----------
    samples, normals : arrays of shape (M, 3), of faces that were continued
    points, their_normals : arrays of shape (N, 3), of the scan
    """
    found = np.zeros(len(samples), dtype=bool)
    if not len(samples):
        return found
    tree, others = cKDTree(points), cKDTree(samples)
    away = tree.query(samples)[0]
    for row, near in enumerate(tree.query_ball_point(samples, WITHIN * away)):
        if not found[row] and _walled(points[near] - samples[row], their_normals[near], normals[row]):
            same = np.array(others.query_ball_point(samples[row], MOUTH * away[row]))
            found[same[normals[same] @ normals[row] > ALIKE]] = True
    return found


def _walled(places: Float, normals: Float, axis: Float) -> bool:
    """Return whether walls, behind the origin along an axis, look to it from all around it."""
    wall = (np.abs(normals @ axis) < ACROSS) & (places @ axis < 0) & (np.einsum("nd,nd->n", normals, places) < 0)
    return bool(widest_gap(places[wall], axis) < OPEN)
