"""Polygons of any number of corners, cut into fans of triangles."""

from __future__ import annotations

import numpy as np

from gnrecon.geometry.arrays import Int


def fan(counts: Int, corners: Int) -> Int:
    """Return triangles, of shape (F, 3), that cover polygons.

    A polygon v0 v1 ... v(n-1) becomes the n - 2 triangles v0 v(k+1) v(k+2); fewer than three corners give none.

    Parameters
    ----------
    counts : integer array of shape (P,), the number of corners of each polygon
    corners : integer array of shape (counts.sum(),), the vertex indices of all polygons in a row
    """
    triangles = np.maximum(counts - 2, 0)
    polygon = np.repeat(np.arange(len(counts)), triangles)
    first = (np.cumsum(counts) - counts)[polygon]
    k = np.arange(len(polygon)) - (np.cumsum(triangles) - triangles)[polygon]
    return np.column_stack([corners[first], corners[first + k + 1], corners[first + k + 2]])


def not_triangles(counts: Int) -> tuple[str, ...]:
    """Say what `fan` does not keep of polygons with so many corners, of shape (P,); nothing for triangles."""
    larger, smaller = int((counts > 3).sum()), int((counts < 3).sum())
    sentences = (
        (larger, f"{larger} polygons of more than three corners as such (they are cut into triangles)"),
        (smaller, f"{smaller} polygons of less than three corners"),
    )
    return tuple(sentence for count, sentence in sentences if count)
