"""Where a mesh of vertices on a surface is farthest from it: at the centres of its faces and the midpoints of edges."""

from __future__ import annotations

import numpy as np

from gnrecon.geometry.arrays import Float


def between(corners: Float) -> Float:
    """Return the centres and then the sides' midpoints, of shape (4 F, 3), of faces given by corners of (F, 3, 3)."""
    midpoints = (corners + np.roll(corners, -1, axis=1)) / 2
    return np.concatenate([corners.mean(axis=1), midpoints.reshape(-1, 3)])
