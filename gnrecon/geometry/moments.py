"""Moments of points, which recognise the same points wherever they lie."""

from __future__ import annotations

import numpy as np

from gnrecon.geometry.arrays import Float


class Moments:
    """Moments of points that come in chunks, which recognise the same scan wherever it lies.

    The number of points and the principal moments of inertia do not change when a scan is moved. They are summed while
    the chunks pass, relative to the scan's first point, so that far-off coordinates lose no digits.
    """

    def __init__(self) -> None:
        self.count = 0
        self._first: Float | None = None
        self._sum, self._products = np.zeros(3), np.zeros((3, 3))

    def add(self, points: Float) -> None:
        """Add a chunk of points, of shape (N, 3); those that are not finite do not count."""
        finite = np.isfinite(points).all(axis=1)
        points = points if finite.all() else points[finite]
        if not len(points):
            return
        if self._first is None:
            self._first = points[0].copy()
        with np.errstate(over="ignore", invalid="ignore"):
            offsets = points - self._first
            self.count += len(points)
            self._sum += offsets.sum(axis=0)
            self._products += offsets.T @ offsets

    def principal(self) -> Float:
        """Return the variances along the principal axes, of shape (3,); NaN where they are not finite."""
        with np.errstate(over="ignore", invalid="ignore"):
            mean = self._sum / max(self.count, 1)
            covariance: Float = self._products / max(self.count, 1) - np.outer(mean, mean)
        if not np.isfinite(covariance).all():
            return np.full(3, np.nan)
        return np.asarray(np.linalg.eigvalsh(covariance), np.float64)

    def same_as(self, other: Moments, *, least_points: int = 25, tolerance: float = 1e-5) -> bool:
        """Whether both may be the same scan, moved or not.

        Moments of fewer than `least_points` may agree by chance; the tolerance, a share of the largest moment, is what
        float32 leaves of coordinates.
        """
        if self.count != other.count or self.count < least_points:
            return False
        mine, theirs = self.principal(), other.principal()
        # Comparing with NaN is false, so scans whose moments overflow never match.
        return bool((np.abs(mine - theirs) <= tolerance * mine.max()).all())
