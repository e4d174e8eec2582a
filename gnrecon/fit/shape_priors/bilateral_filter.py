"""Noisy points averaged with those neighbours whose normals agree, so that edges stay sharp.

A sum of smooth features is a poor belief about noisy points at a sharp edge: what is smooth enough to average the noise
rounds the edge. Averaging first over the neighbours on the same side of the edge, which their normals tell, takes the
noise away on faces, and leaves the edge to the fit.

A point x with normal n moves along it by the mean over its neighbours y, with normals m, of (y - x).(n + m) / 2. That
is nothing on planes and on spheres, and of third order in the neighbours' distance on other smooth surfaces, so that
round shapes neither shrink nor flatten. Before that, normals are averaged in the same way.

Behind a thin wall there may be a surface with the same normals, as that of a bore is in places. Its heights differ from
those of most neighbours, and count for the less.
Source: bilateral filtering of meshes and points (Fleishman, Drori and Cohen-Or, Bilateral mesh denoising, 2003; Jones,
Durand and Desbrun, Non-iterative, feature-preserving mesh smoothing, 2003); the symmetric distance of two oriented
points is that of Rusinkiewicz, A symmetric objective function for ICP (2019), section 3.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gnrecon.geometry.arrays import Float, Int
from gnrecon.geometry.signed_distance import Density
from gnrecon.geometry.statistics import robust_deviation
from gnrecon.runtime.chunks import slices

Part = tuple[slice, Int, Float]

PASSES = 3
"""Times that the normals are averaged, and after that the points."""

REACH = 2.0
"""Distance, in widths, up to which neighbours count; beyond it their weight is below a fiftieth."""

MOST = 100
"""Most neighbours of a point."""

DEVIATIONS, COUNTED = 3.0, 0.2
"""Height of a neighbour at which its weight is 1/e, in deviations of the heights of those that count, and their least
weight, over the largest."""

LEAST_HEIGHT = 1e-3
"""That height at least, in widths: heights on exact planes are rounding errors."""

ASKED = 20_000
"""Most points whose neighbours' heights tell that deviation."""

ROWS = 20_000
"""Points that are averaged at once, so that memory does not grow with the scan."""


@dataclass(frozen=True)
class Averaging:
    """How points are averaged.

    Parameters
    ----------
    width : distance at which a neighbour's weight is 1/e, in radii of the point's disk
    difference : length of the difference of two unit normals at which it is
    """

    width: float
    difference: float

    def of(self, points: Float, normals: Float) -> tuple[Float, Float]:
        """Return points and unit normals, both of shape (N, 3), averaged."""
        parts, some = self._neighbours(points)
        for _ in range(PASSES):
            normals = np.concatenate([self._normals(points, normals, *part) for part in parts])
        for _ in range(PASSES):
            usual = self._deviation(points, normals, *some)
            points = np.concatenate([self._points(points, normals, *part, usual) for part in parts])
        return points, normals

    def _neighbours(self, points: Float) -> tuple[list[Part], Part]:
        """Return rows, neighbours, of shape (rows, k), and widths, of shape (rows, 1): of all in parts, and of some.

        The last are spread over all points.
        """
        density = Density(points)
        # In disks of radius r there are (R / r)^2 points within R.
        count = min(len(points), MOST, int(np.ceil((REACH * self.width) ** 2)) + 1)
        near = density.tree.query(points, list(range(1, count + 1)))[1]
        all_rows = [*slices(len(points), ROWS), slice(None, None, -(-len(points) // ASKED))]
        parts = [(rows, near[rows], self.width * density.disks[rows, None]) for rows in all_rows]
        return parts[:-1], parts[-1]

    def _weights(self, points: Float, normals: Float, rows: slice, near: Int, widths: Float) -> Float:
        """Return the neighbours' weights, of shape (rows, k), whose sums are one."""
        apart = np.linalg.norm(points[near] - points[rows, None], axis=2) / widths
        unlike = np.linalg.norm(normals[near] - normals[rows, None], axis=2) / self.difference
        weights = np.exp(-(apart**2) - unlike**2)
        shares: Float = weights / weights.sum(axis=1, keepdims=True)
        return shares

    def _normals(self, points: Float, normals: Float, rows: slice, near: Int, widths: Float) -> Float:
        """Return the mean normals of some rows; each counts for itself and opposed ones hardly, so none is zero."""
        weights = self._weights(points, normals, rows, near, widths)
        mean = np.einsum("ik,ikd->id", weights, normals[near])
        unit: Float = mean / np.linalg.norm(mean, axis=1, keepdims=True)
        return unit

    def _deviation(self, points: Float, normals: Float, rows: slice, near: Int, widths: Float) -> float:
        """Return how far most neighbours that count are off some rows of the points, as a standard deviation."""
        weights = self._weights(points, normals, rows, near, widths)[:, 1:]
        heights = _heights(points, normals, rows, near[:, 1:])
        counted = weights > COUNTED * weights.max(axis=1, keepdims=True, initial=0.0)
        return robust_deviation(heights[counted]) if counted.any() else 0.0

    def _points(self, points: Float, normals: Float, rows: slice, near: Int, widths: Float, usual: float) -> Float:
        """Return some rows of the points, moved along their normals."""
        heights = _heights(points, normals, rows, near)
        weights = self._weights(points, normals, rows, near, widths)
        weights *= np.exp(-((heights / np.maximum(DEVIATIONS * usual, LEAST_HEIGHT * widths)) ** 2))
        moved: Float = points[rows] + ((weights * heights).sum(axis=1) / weights.sum(axis=1))[:, None] * normals[rows]
        return moved


def _heights(points: Float, normals: Float, rows: slice, near: Int) -> Float:
    """Return how high each neighbour is over some rows of the points, of shape (rows, k), by both normals."""
    between = (normals[near] + normals[rows, None]) / 2
    heights: Float = np.einsum("ikd,ikd->ik", points[near] - points[rows, None], between)
    return heights
