"""Whether heights over a surface are noise, or show that the surface is bent otherwise.

Noise of one point has nothing to do with that of its neighbours, and a quadric explains no more of it than it has
terms.
"""

from __future__ import annotations

import numpy as np

from gnrecon.geometry.arrays import Float
from gnrecon.geometry.signed_distance import Density

ALIKE, BESIDE = 2.5, 6
"""Most correlation of a height with its neighbours' mean, times the root of their number; and how many neighbours."""

BENT, RANK = 3.0, 0.01
"""By how many deviations of it a quadric may explain the heights better than it explains noise; and how much smaller
than the largest of its terms one may be, over the points, that counts."""


def is_white(height: Float, points: Float, feet: Float) -> bool:
    """Return whether heights over a surface look like noise.

    Parameters
    ----------
    height : array of shape (K,), not all of them zero
    points : array of shape (K, 3), that are so high
    feet : array of shape (K, 3), where the surface is that they are over
    """
    near = Density(points).tree.query(points, list(range(2, min(BESIDE, len(points) - 1) + 2)))[1]
    alike = float((height * height[near].mean(axis=1)).mean()) / float(np.mean(height**2))
    bent, terms = _explained(height, feet)
    return bool(alike < ALIKE / np.sqrt(len(points)) and bent < terms + BENT * np.sqrt(2 * terms))


def _explained(height: Float, points: Float) -> tuple[float, int]:
    """Return how much of some heights, of shape (K,), a quadric explains, in their variance, and by how many terms.

    Of noise it explains as much as it has terms, in the mean, and with twice that as the variance.

    Parameters
    ----------
    height : array of shape (K,)
    points : array of shape (K, 3), where the surface is that they are over
    """
    x = points - points.mean(axis=0)
    x = x / np.abs(x).max()
    i, j = np.triu_indices(3)
    terms = np.concatenate([np.ones((len(x), 1)), x, x[:, i] * x[:, j]], axis=1)
    basis, size, _ = np.linalg.svd(terms, full_matrices=False)
    basis = basis[:, size > RANK * size[0]]
    return float(((basis.T @ height) ** 2).sum() / np.mean(height**2)), basis.shape[1]
