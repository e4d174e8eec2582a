"""Bilateral filter of noisy points: averages over neighbours with similar normals, so that edges stay sharp.

A sum of smooth features is a poor prior for noisy points at a sharp edge: when it is smooth enough to average noise, it
rounds the edge. Averaging first over the neighbours on the same side of the edge, recognised by their normals, removes
the noise on faces and leaves the edge to the fit.

A point x with normal n moves along n by the weighted mean of (y - x).(n + m) / 2 over its neighbours y with normals m.
This is zero on planes and spheres, and of third order in the neighbours' distance on other smooth surfaces, so that
round shapes neither shrink nor flatten. Normals are averaged first, with the same weights.

Behind a thin wall there may be a surface with the same normals, as that of a bore is in places. Its heights differ from
those of most neighbours, so that a third weight reduces its influence.
Sources: Fleishman, Drori and Cohen-Or, Bilateral mesh denoising (2003); Jones, Durand and Desbrun, Non-iterative,
feature-preserving mesh smoothing (2003); the symmetric distance of two oriented points is that of Rusinkiewicz, A
symmetric objective function for ICP (2019), section 3. Entry: `BilateralFilter.apply`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from gnrecon.fit.shape_priors.prior_parameters import BilateralParameters
from gnrecon.geometry.arrays import Float, Int
from gnrecon.geometry.signed_distance import Density
from gnrecon.geometry.statistics import robust_deviation
from gnrecon.runtime.chunks import slices
from gnrecon.runtime.parallel import map_in_threads

Neighbourhoods = tuple[slice, Int, Float]


@dataclass(frozen=True)
class BilateralFilter:
    """How points are averaged.

    Parameters
    ----------
    width_radii : distance at which a neighbour's weight is 1/e, in radii of the point's disk
    normal_scale : length of the difference of two unit normals at which it is 1/e
    parameters : of the averaging
    """

    width_radii: float
    normal_scale: float
    parameters: BilateralParameters = BilateralParameters()

    def apply(self, points: Float, normals: Float) -> tuple[Float, Float]:
        """Return points and unit normals, both of shape (N, 3), averaged."""
        parts, sample = self._neighbourhoods(points)
        for _ in range(self.parameters.passes):
            normals = np.concatenate(map_in_threads(partial(self._mean_normals, points, normals), parts))
        for _ in range(self.parameters.passes):
            usual = self._height_deviation(points, normals, *sample)
            points = np.concatenate(map_in_threads(partial(self._moved, points, normals, usual), parts))
        return points, normals

    def _neighbourhoods(self, points: Float) -> tuple[list[Neighbourhoods], Neighbourhoods]:
        """Return rows, neighbours, of shape (rows, k), and widths, of shape (rows, 1), of all points in parts.

        The last result is the same of a sample of all points.
        """
        density, p = Density(points), self.parameters
        # In disks of radius r there are (R / r)^2 points within R.
        count = min(len(points), p.max_neighbours, int(np.ceil((p.reach_widths * self.width_radii) ** 2)) + 1)
        near = density.tree.query(points, list(range(1, count + 1)))[1]
        sample = slice(None, None, -(-len(points) // p.deviation_points))
        parts = [
            (rows, near[rows], self.width_radii * density.disks[rows, None])
            for rows in [*slices(len(points), p.chunk_points), sample]
        ]
        return parts[:-1], parts[-1]

    def _weights(self, points: Float, normals: Float, rows: slice, near: Int, widths: Float) -> Float:
        """Return the neighbours' weights, of shape (rows, k), whose sums are one."""
        apart = _squares(points, rows, near) / widths**2
        apart += _squares(normals, rows, near) / self.normal_scale**2
        weights = np.exp(-apart)
        shares: Float = weights / weights.sum(axis=1, keepdims=True)
        return shares

    def _mean_normals(self, points: Float, normals: Float, part: Neighbourhoods) -> Float:
        """Return the mean normals of some rows; each counts itself and hardly any opposed ones, so none is zero."""
        weights = self._weights(points, normals, *part)
        mean = np.einsum("ik,ikd->id", weights, normals[part[1]])
        unit: Float = mean / np.linalg.norm(mean, axis=1, keepdims=True)
        return unit

    def _height_deviation(self, points: Float, normals: Float, rows: slice, near: Int, widths: Float) -> float:
        """Return the robust standard deviation of the heights of neighbours with large weights, over some rows."""
        weights = self._weights(points, normals, rows, near, widths)[:, 1:]
        heights = _heights(points, normals, rows, near[:, 1:])
        counted = weights > self.parameters.min_weight_share * weights.max(axis=1, keepdims=True, initial=0.0)
        return robust_deviation(heights[counted]) if counted.any() else 0.0

    def _moved(self, points: Float, normals: Float, usual: float, part: Neighbourhoods) -> Float:
        """Return some rows of the points, moved along their normals."""
        p, (rows, near, widths) = self.parameters, part
        heights = _heights(points, normals, rows, near)
        weights = self._weights(points, normals, rows, near, widths)
        weights *= np.exp(-((heights / np.maximum(p.height_deviations * usual, p.min_height_widths * widths)) ** 2))
        moved: Float = points[rows] + ((weights * heights).sum(axis=1) / weights.sum(axis=1))[:, None] * normals[rows]
        return moved


def _squares(x: Float, rows: slice, near: Int) -> Float:
    """Return the squared distances of each neighbour from some rows of x, of shape (rows, k)."""
    # Axis by axis, here and below, as sums over an array's short last axis take several times as long.
    squares = np.zeros(near.shape)
    for along in x.T:
        squares += (along[near] - along[rows, None]) ** 2
    return squares


def _heights(points: Float, normals: Float, rows: slice, near: Int) -> Float:
    """Return how high each neighbour is over some rows of the points, of shape (rows, k), by both normals."""
    heights = np.zeros(near.shape)
    for x, n in zip(points.T, normals.T, strict=True):
        heights += (x[near] - x[rows, None]) * (n[near] + n[rows, None])
    return heights / 2
