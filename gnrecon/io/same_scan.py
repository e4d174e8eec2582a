"""Telling that two files hold the same scan, wherever each of them puts it.

The number of points and the principal moments of inertia do not change when a scan is moved. They are summed while the
chunks pass, about a scan's first point, so that far-off coordinates lose no digits.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gnrecon.geometry.arrays import Float

_LEAST = 25
"""Points below which moments may agree by chance."""

_AGREEMENT = 1e-5
"""Of the moments, as a share of the largest: what float32 leaves of coordinates."""


class Moments:
    """Sums over the points of one file."""

    def __init__(self) -> None:
        self.count = 0
        self._first: Float | None = None
        self._sum, self._products = np.zeros(3), np.zeros((3, 3))

    def add(self, points: Float) -> None:
        """Take a chunk of points, of shape (N, 3); those that are not finite do not count."""
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

    def same_as(self, other: Moments) -> bool:
        """Whether both may be the same scan, moved or not."""
        if self.count != other.count or self.count < _LEAST:
            return False
        mine, theirs = self.principal(), other.principal()
        return bool((np.abs(mine - theirs) <= _AGREEMENT * mine.max()).all())


def same_scans(files: Sequence[str], moments: Sequence[Moments]) -> tuple[tuple[str, str], ...]:
    """Return pairs of files that hold the same scan, each file at most once as the second one."""
    found = []
    for place, name in enumerate(files):
        earlier = (one for one in range(place) if moments[one].same_as(moments[place]))
        if (first := next(earlier, None)) is not None:
            found.append((files[first], name))
    return tuple(found)
