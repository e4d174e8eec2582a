"""A scan of a can with a hole in its side: a cylinder between two flat lids, whose truth is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gnrecon import PointCloud
from gnrecon.geometry.arrays import Float, Mask


@dataclass(frozen=True)
class Can:
    """A cylinder along z between two flat lids, around the origin."""

    radius: float = 0.5
    half_height: float = 0.8

    def scan(self, spacing: float, hole: float) -> PointCloud:
        """Return evenly spaced points with normals, except in a ball of radius `hole` around the middle of the hole."""
        side, outward = self._side(spacing)
        lid = self._lid(spacing)
        up = np.tile([0.0, 0.0, 1.0], (len(lid), 1))
        points = np.concatenate([side, lid, lid * [1, 1, -1]])
        normals = np.concatenate([outward, up, -up])
        kept = ~self.in_hole(points, hole)
        return PointCloud(points[kept], normals[kept])

    def in_hole(self, x: Float, hole: float) -> Mask:
        """Return which points, of shape (N, 3), lie within `hole` of (radius, 0, 0), the middle of the hole."""
        return np.asarray(np.linalg.norm(x - [self.radius, 0, 0], axis=1) <= hole)

    def distance(self, x: Float) -> Float:
        """Return the signed distance to the whole can, of shape (N,), at x, of shape (N, 3)."""
        away = np.stack([np.hypot(x[:, 0], x[:, 1]) - self.radius, np.abs(x[:, 2]) - self.half_height], axis=1)
        outside: Float = np.linalg.norm(np.maximum(away, 0), axis=1) + np.minimum(away.max(axis=1), 0)
        return outside

    def _side(self, spacing: float) -> tuple[Float, Float]:
        around, along = round(2 * np.pi * self.radius / spacing), round(2 * self.half_height / spacing)
        row, column = np.divmod(np.arange(around * along), around)
        # Every other row is rotated by half a step.
        angle = 2 * np.pi * (column + 0.5 * (row % 2)) / around
        height = ((row + 0.5) / along * 2 - 1) * self.half_height
        outward = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
        return self.radius * outward + height[:, None] * [0, 0, 1], outward

    def _lid(self, spacing: float) -> Float:
        """Return points of the upper lid on a Fibonacci spiral."""
        count = round(np.pi * self.radius**2 / spacing**2)
        spread = self.radius * np.sqrt((np.arange(count) + 0.5) / count)
        turn = np.pi * (1 + 5**0.5) * np.arange(count)
        return np.stack([spread * np.cos(turn), spread * np.sin(turn), np.full(count, self.half_height)], axis=1)
