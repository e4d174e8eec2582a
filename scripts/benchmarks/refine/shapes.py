"""Exactly known signed distances with sharp edges and without, as fields to mesh."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from gnrecon.geometry.arrays import Float
from gnrecon.geometry.point_cloud import Frame

STEP = 1e-6


@dataclass(frozen=True)
class Shape:
    """A signed distance within the cube of half side one, its gradient by central differences."""

    distance: Callable[[Float], Float]
    frame: Frame = field(default_factory=lambda: Frame(np.zeros(3), 1.0))

    @property
    def bounds(self) -> Float:
        """Corners of the cube, of shape (2, 3)."""
        return np.array([[-1.0] * 3, [1.0] * 3])

    def sdf(self, points: Float) -> Float:
        """Return distances, of shape (N,), at points, of shape (N, 3)."""
        return self.distance(points)

    def gradient(self, points: Float) -> Float:
        """Return gradients, of shape (N, 3), at points, of shape (N, 3)."""
        slopes = [(self.sdf(points + step) - self.sdf(points - step)) / (2 * STEP) for step in STEP * np.eye(3)]
        return np.stack(slopes, axis=1)


def sphere(x: Float) -> Float:
    """Return the distance to a sphere of radius 0.8."""
    distance: Float = np.linalg.norm(x, axis=1) - 0.8
    return distance


def cylinder(x: Float) -> Float:
    """Return the distance, exact inside and near the faces, to a cylinder of radius 0.6 and half height 0.5."""
    around, along = np.hypot(x[:, 0], x[:, 1]) - 0.6, np.abs(x[:, 2]) - 0.5
    distance: Float = np.maximum(around, along)
    return distance


def notched(x: Float) -> Float:
    """Return the distance, likewise, to a box of half side 0.6 with a notch cut out of one of its edges."""
    box = (np.abs(x) - 0.6).max(axis=1)
    notch = np.maximum(0.1 - x[:, 0], 0.1 - x[:, 1])
    distance: Float = np.maximum(box, -notch)
    return distance


SHAPES = {"cylinder": (Shape(cylinder), 0.08), "notched box": (Shape(notched), 0.08), "sphere": (Shape(sphere), 0.05)}
"""Fields with the edge length to remesh them to."""
