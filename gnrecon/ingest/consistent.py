"""Normals that agree with the winding number that they make: a refinement of those of `gauss`, thin walls included.

The winding number w of area vectors mu_j changes fastest across the surface, so that the right normals are those of
-grad w. Each round takes a step of steepest descent towards w = 1/2 at all points, with the exact length, and then
turns every mu_j to -grad w at its point. Neighbourhoods play no part; each point smooths the kernel over its own width,
as in `gauss`.
Source: Lin, Shi, Liu, *Fast and Globally Consistent Normal Orientation based on the Winding Number Normal Consistency*
(ACM TOG 2024).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from gnrecon.geometry.arrays import Float
from gnrecon.ingest.spacing import mean_distances

Single = npt.NDArray[np.float32]

_WIDTH = 0.75
"""Of the kernel, in mean distances of a point to its nearest neighbours."""

_ROUNDS = 10


def consistent_normals(points: Float, normals: Float) -> Float:
    """Return outward unit normals, of shape (N, 3).

    Parameters
    ----------
    points : array of shape (N, 3), distinct, samples of a closed surface; at most a few thousand
    normals : array of shape (N, 3), of unit length, a first guess, such as that of `gauss`
    """
    scaled = points / np.abs(points).max()
    apart, count = mean_distances(scaled)
    field = _Winding(scaled.astype(np.float32), (_WIDTH * apart).astype(np.float32))
    mu = (normals * (np.pi / count * apart**2)[:, None]).astype(np.float32)
    for _ in range(_ROUNDS):
        downhill = field.back(0.5 - field.at_points(mu))
        change = field.at_points(downhill)
        mu = mu + (downhill**2).sum() / max(float((change**2).sum()), 1e-30) * downhill
        steepest = field.descent(mu)
        mu = np.linalg.norm(mu, axis=1, keepdims=True) * _unit(steepest)
    refined = mu.astype(np.float64)
    return np.asarray(refined / np.linalg.norm(refined, axis=1, keepdims=True))


class _Winding:
    """w(p_i) = sum_j G_ij (p_j - p_i) . mu_j, with G_ij = 1 / (4 pi max(|p_j - p_i|, width_i)^3)."""

    def __init__(self, points: Single, widths: Single) -> None:
        from scipy.spatial.distance import cdist

        distances = cdist(points, points).astype(np.float32)
        bounded = np.maximum(distances, widths[:, None])
        self._points = points
        square = bounded * bounded
        self._kernel = 1 / (np.float32(4 * np.pi) * bounded * square)
        # Within the width the kernel is constant, so that there its slope adds nothing.
        self._slope = np.where(distances < widths[:, None], np.float32(0), 3 * self._kernel / square)

    def at_points(self, mu: Single) -> Single:
        """Return w, of shape (N,)."""
        p = self._points
        found: Single = self._kernel @ (p * mu).sum(axis=1) - (p * (self._kernel @ mu)).sum(axis=1)
        return found

    def back(self, values: Single) -> Single:
        """Return the transpose of `at_points` times values of shape (N,): of shape (N, 3)."""
        p = self._points
        found: Single = p * (self._kernel.T @ values)[:, None] - self._kernel.T @ (p * values[:, None])
        return found

    def descent(self, mu: Single) -> Single:
        """Return -grad w at the points, of shape (N, 3)."""
        p = self._points
        along = self._slope * ((p * mu).sum(axis=1)[None, :] - p @ mu.T)
        found: Single = self._kernel @ mu - (along @ p - p * along.sum(axis=1)[:, None])
        return found


def _unit(vectors: Single) -> Single:
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    found: Single = vectors / np.maximum(lengths, np.float32(1e-30))
    return found
