"""Noisy points averaged with those neighbours whose normals agree, so that edges stay sharp.

A sum of smooth features is a poor belief about noisy points at a sharp edge: what is smooth enough to average the noise
rounds the edge. Averaging first over the neighbours on the same side of the edge, which their normals tell, takes the
noise away on faces, and leaves the edge to the fit.

A point x with normal n moves along it by the mean over its neighbours y, with normals m, of (y - x).(n + m) / 2. That
is nothing on planes and on spheres, and of third order in the neighbours' distance on other smooth surfaces, so that
round shapes neither shrink nor flatten. Before that, normals are averaged in the same way.
Source: bilateral filtering of meshes and points (Fleishman, Drori and Cohen-Or, Bilateral mesh denoising, 2003; Jones,
Durand and Desbrun, Non-iterative, feature-preserving mesh smoothing, 2003); the symmetric distance of two oriented
points is that of Rusinkiewicz, A symmetric objective function for ICP (2019), section 3.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from gnrecon.cloud import Float
from gnrecon.sampling import Density
from gnrecon.slices import slices

Int = npt.NDArray[np.integer]

PASSES = 3
"""Times that the normals are averaged, and after that the points."""

REACH = 2.0
"""Distance, in widths, up to which neighbours count; beyond it their weight is below a fiftieth."""

MOST = 100
"""Most neighbours of a point."""

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
        parts = list(self._neighbours(points))
        for _ in range(PASSES):
            normals = np.concatenate([self._normals(points, normals, *part) for part in parts])
        for _ in range(PASSES):
            points = np.concatenate([self._points(points, normals, *part) for part in parts])
        return points, normals

    def _neighbours(self, points: Float) -> list[tuple[slice, Int, Float]]:
        """Return rows, their neighbours, of shape (rows, k), and their widths, of shape (rows, 1)."""
        density = Density(points)
        # In disks of radius r there are (R / r)^2 points within R.
        count = min(len(points), MOST, int(np.ceil((REACH * self.width) ** 2)) + 1)
        near = density.tree.query(points, list(range(1, count + 1)))[1]
        return [(rows, near[rows], self.width * density.disks[rows, None]) for rows in slices(len(points), ROWS)]

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

    def _points(self, points: Float, normals: Float, rows: slice, near: Int, widths: Float) -> Float:
        """Return some rows of the points, moved along their normals."""
        weights = self._weights(points, normals, rows, near, widths)
        between = (normals[near] + normals[rows, None]) / 2
        height = np.einsum("ik,ikd,ikd->i", weights, points[near] - points[rows, None], between)
        moved: Float = points[rows] + height[:, None] * normals[rows]
        return moved
