"""Angles about an axis."""

from __future__ import annotations

import numpy as np

from gnrecon.geometry.arrays import Float


def widest_gap(directions: Float, axis: Float) -> float:
    """Return the widest angle about an axis, of shape (3,), into which none of the directions looks, in radians.

    Parameters
    ----------
    directions : array of shape (N, 3)
        Their parts along the axis do not matter; without any the whole circle is bare.
    """
    if not len(directions):
        return 2 * np.pi
    across = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    angles = np.sort(np.arctan2(directions @ np.cross(axis, across), directions @ across))
    return float(np.diff(np.append(angles, angles[0] + 2 * np.pi)).max())
