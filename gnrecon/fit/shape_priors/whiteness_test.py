"""Whiteness test of fit residuals: whether heights over a surface are noise, or show that it is bent otherwise.

White noise is uncorrelated between neighbours, and a quadric explains no more of it than it has terms. Both statistics
are compared with their distribution under white noise. Entry: `is_white_noise`.
"""

from __future__ import annotations

import numpy as np

from gnrecon.geometry.arrays import Float
from gnrecon.geometry.signed_distance import Density


def is_white_noise(
    height: Float,
    points: Float,
    projections: Float,
    *,
    neighbours: int = 6,
    max_correlation: float = 2.5,
    max_quadric_deviations: float = 3.0,
) -> bool:
    """Return whether heights over a surface look like white noise.

    Parameters
    ----------
    height : array of shape (K,), not all of them zero
    points : array of shape (K, 3), at these heights
    projections : array of shape (K, 3), of the points onto the surface
    neighbours : of a point, with whose mean height its own is correlated
    max_correlation : of both, in units of 1 / sqrt(K), the standard error of a correlation of K pairs
    max_quadric_deviations : by which a quadric may explain more of the heights than it explains of noise, in standard
        deviations of the latter
    """
    near = Density(points).tree.query(points, list(range(2, min(neighbours, len(points) - 1) + 2)))[1]
    correlation = float((height * height[near].mean(axis=1)).mean()) / float(np.mean(height**2))
    explained, terms = _explained_by_quadric(height, projections)
    return bool(
        correlation < max_correlation / np.sqrt(len(points))
        and explained < terms + max_quadric_deviations * np.sqrt(2 * terms)
    )


def _explained_by_quadric(height: Float, points: Float, *, rank_tolerance: float = 0.01) -> tuple[float, int]:
    """Return how much of some heights a quadric explains, over their variance, and its number of terms.

    Of white noise the first follows a chi-squared distribution: its mean is the number of terms, its variance twice it.

    Parameters
    ----------
    height : array of shape (K,)
    points : array of shape (K, 3), at which the quadric is evaluated
    rank_tolerance : least singular value of the terms that count, over the largest; on a plane some terms are dependent
    """
    x = points - points.mean(axis=0)
    x = x / np.abs(x).max()
    i, j = np.triu_indices(3)
    terms = np.concatenate([np.ones((len(x), 1)), x, x[:, i] * x[:, j]], axis=1)
    basis, size, _ = np.linalg.svd(terms, full_matrices=False)
    basis = basis[:, size > rank_tolerance * size[0]]
    return float(((basis.T @ height) ** 2).sum() / np.mean(height**2)), basis.shape[1]
