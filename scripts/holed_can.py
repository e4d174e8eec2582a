"""A scan of a can with a hole in its side: a cylinder between two flat lids, whose truth is known."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from gnrecon import PointCloud

Float = npt.NDArray[np.float64]

RADIUS, HALF_HEIGHT = 0.5, 0.8


def can(spacing: float, hole: float) -> PointCloud:
    """Return evenly spread points of the can with normals, but for a ball of radius `hole` about (RADIUS, 0, 0)."""
    side, outward = _side(spacing)
    lid = _lid(spacing)
    up = np.tile([0.0, 0.0, 1.0], (len(lid), 1))
    points = np.concatenate([side, lid, lid * [1, 1, -1]])
    normals = np.concatenate([outward, up, -up])
    kept = np.linalg.norm(points - [RADIUS, 0, 0], axis=1) > hole
    return PointCloud(points[kept], normals[kept])


def distance(x: Float) -> Float:
    """Return the signed distance to the whole can, of shape (N,), at x, of shape (N, 3)."""
    away = np.stack([np.hypot(x[:, 0], x[:, 1]) - RADIUS, np.abs(x[:, 2]) - HALF_HEIGHT], axis=1)
    outside: Float = np.linalg.norm(np.maximum(away, 0), axis=1) + np.minimum(away.max(axis=1), 0)
    return outside


def _side(spacing: float) -> tuple[Float, Float]:
    around, along = round(2 * np.pi * RADIUS / spacing), round(2 * HALF_HEIGHT / spacing)
    row, column = np.divmod(np.arange(around * along), around)
    # Every other row is turned by half a step.
    angle = 2 * np.pi * (column + 0.5 * (row % 2)) / around
    height = ((row + 0.5) / along * 2 - 1) * HALF_HEIGHT
    outward = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
    return RADIUS * outward + height[:, None] * [0, 0, 1], outward


def _lid(spacing: float) -> Float:
    """Points of the upper lid on a Fibonacci spiral."""
    count = round(np.pi * RADIUS**2 / spacing**2)
    spread = RADIUS * np.sqrt((np.arange(count) + 0.5) / count)
    turn = np.pi * (1 + 5**0.5) * np.arange(count)
    return np.stack([spread * np.cos(turn), spread * np.sin(turn), np.full(count, HALF_HEIGHT)], axis=1)
