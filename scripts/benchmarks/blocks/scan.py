"""A scan of any size: a rippled ball, sampled one point a unit square, whose true surface is known in closed form.

The surface is |x| = R + h(x / |x|), where h sums waves of lengths from twenty spacings of the points up to the radius,
each octave as steep as the others, as eroded ground is. A scan of more points is one of a larger ball at the same
spacing: as with a real scanner, the finest detail is as many points wide whatever the size, so that what a point costs
and how well it is fitted can be compared.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from gnrecon.geometry.point_cloud import PointCloud

Float = npt.NDArray[np.float64]

FINEST, STEEPNESS, WAVES = 20.0, 0.12, 6
"""Length of the shortest waves, in spacings; slope of an octave's steepest places; waves an octave."""

POSITION, ANGLE = 0.1, 3.0
"""Standard deviations of the noise: of positions along the normal, in spacings, and of normals, in degrees."""

BATCH = 100_000


@dataclass(frozen=True)
class Ball:
    """The true surface of a scan of about `points` points of spacing one.

    Parameters
    ----------
    points : int
    seed : int
        Of its waves.
    """

    points: int
    seed: int = 0

    @cached_property
    def radius(self) -> float:
        """Of the ball, in spacings."""
        return float(np.sqrt(self.points / (4 * np.pi)))

    @cached_property
    def _waves(self) -> tuple[Float, Float, Float]:
        """Wave vectors on the unit sphere, of shape (W, 3), phases and heights, of shape (W,)."""
        rng = np.random.default_rng(self.seed)
        octaves = max(1, int(np.log2(self.radius / FINEST)) + 1)
        lengths = np.repeat(FINEST * 2.0 ** np.arange(octaves), WAVES)
        axes = rng.standard_normal((len(lengths), 3))
        axes /= np.linalg.norm(axes, axis=1, keepdims=True)
        heights = STEEPNESS / np.sqrt(WAVES) * lengths / (2 * np.pi)
        return 2 * np.pi * self.radius / lengths[:, None] * axes, rng.uniform(0, 2 * np.pi, len(lengths)), heights

    def height(self, u: Float) -> tuple[Float, Float]:
        """Return R + h, of shape (N,), and the gradient of h, of shape (N, 3), at unit vectors of shape (N, 3)."""
        vectors, phases, heights = self._waves
        z = u @ vectors.T + phases
        return self.radius + np.sin(z) @ heights, (np.cos(z) * heights) @ vectors

    def distances(self, x: Float) -> Float:
        """Return how far points, of shape (N, 3), lie outside of the surface, to first order, of shape (N,)."""
        parts = [np.zeros(0)]
        for start in range(0, len(x), BATCH):
            value, gradient = self._implicit(x[start : start + BATCH])
            parts.append(value / np.linalg.norm(gradient, axis=1))
        return np.concatenate(parts)

    def _implicit(self, x: Float) -> tuple[Float, Float]:
        """Return |x| - R - h(x / |x|) and its gradient."""
        far = np.linalg.norm(x, axis=1, keepdims=True)
        u = x / far
        height, slope = self.height(u)
        along = np.einsum("nc,nc->n", slope, u)[:, None]
        return far[:, 0] - height, u - (slope - along * u) / far

    def scan(self, seed: int = 1, noisy: bool = True, count: int | None = None) -> PointCloud:
        """Return points in random places with normals, noisy or exact; by default as many as the scan has."""
        rng, count = np.random.default_rng(seed), self.points if count is None else count
        points, normals = np.empty((count, 3)), np.empty((count, 3))
        for start in range(0, count, BATCH):
            rows = slice(start, min(start + BATCH, count))
            u = rng.standard_normal((rows.stop - start, 3))
            u /= np.linalg.norm(u, axis=1, keepdims=True)
            exact = u * self.height(u)[0][:, None]
            gradient = self._implicit(exact)[1]
            outward = gradient / np.linalg.norm(gradient, axis=1, keepdims=True)
            points[rows] = exact + noisy * POSITION * rng.standard_normal((len(u), 1)) * outward
            turned = outward + noisy * np.radians(ANGLE) * rng.standard_normal(u.shape)
            normals[rows] = turned / np.linalg.norm(turned, axis=1, keepdims=True)
        return PointCloud(points, normals)
