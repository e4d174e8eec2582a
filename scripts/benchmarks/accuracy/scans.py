"""Scans of the analytic shapes, with the faults that scans have, each of a stated size and drawn by seed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.accuracy.solids import SOLIDS, Solid
from benchmarks.problem import Problem
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.point_cloud import PointCloud

ROOM = 1.1
"""Half the side of the box, in radii, in which outliers are scattered."""


@dataclass(frozen=True)
class AnalyticScan:
    """A scan of one of the shapes, whose radius is one.

    Parameters
    ----------
    shape : name in `solids.SOLIDS`
    points : how many, uniform by area where nothing else is said
    noise : standard deviation of each coordinate
    tilt : angle in degrees by which each normal is turned, in a direction of its own
    uneven : how many times denser the points are at x = 1 than at x = -1, exponential between them
    hole : radius of a ball about a random place of the surface in which there are no points
    outliers : share of the points that are replaced by points anywhere in a box, with normals in any direction
    normals : whether the scan has any
    """

    shape: str
    points: int
    noise: float = 0.0
    tilt: float = 0.0
    uneven: float = 1.0
    hole: float = 0.0
    outliers: float = 0.0
    normals: bool = True

    def problem(self, data: Path, seed: int) -> Problem:  # noqa: ARG002 - other cases read files
        """Return the scan of a seed, and the exact shape."""
        solid, rng = SOLIDS[self.shape], np.random.default_rng(seed)
        points, normals = self._places(solid, rng)
        points = points + self.noise * rng.standard_normal(points.shape)
        normals = tilted(normals, self.tilt, rng)
        if self.outliers:
            rows = rng.choice(self.points, round(self.outliers * self.points), replace=False)
            points[rows] = rng.uniform(-ROOM, ROOM, (len(rows), 3))
            normals[rows] = unit(rng.standard_normal((len(rows), 3)))
        scan = PointCloud(points, normals if self.normals else None)
        return Problem(scan, solid.mesh(), solid.genus, outliers=self.outliers > 0)

    def _places(self, solid: Solid, rng: np.random.Generator) -> tuple[Float, Float]:
        """Return points on the surface outside of the hole, with the wanted density, and their normals."""
        middle = solid.draw(1, rng)[0]
        kept = np.empty((0, 6))
        while len(kept) < self.points:
            points, normals = solid.draw(self.points, rng)
            # Where x is 1 each is kept, elsewhere as many as the density asks for.
            wanted = rng.random(len(points)) < self.uneven ** ((points[:, 0] - 1) / 2)
            wanted &= np.linalg.norm(points - middle, axis=1) >= self.hole
            kept = np.concatenate([kept, np.hstack([points, normals])[wanted]])
        return kept[: self.points, :3], kept[: self.points, 3:]


def tilted(normals: Float, degrees: float, rng: np.random.Generator) -> Float:
    """Return unit normals, of shape (N, 3), each turned by the angle about a random axis across it."""
    across = np.cross(normals, unit(rng.standard_normal(normals.shape)))
    angle = np.radians(degrees)
    return np.asarray(np.cos(angle) * normals + np.sin(angle) * unit(across))


def unit(vectors: Float) -> Float:
    """Return vectors, of shape (N, 3), at length one."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))
