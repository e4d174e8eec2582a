"""Scans of exactly known shapes, thin, noisy and with holes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from sample_shapes import SHAPES, Shape, gradient, project

from benchmarks.provenance import REPOSITORY
from gnrecon.export.metrics import sample_surface
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.point_cloud import Frame, PointCloud
from gnrecon.io import read_mesh

NORMAL_NOISE = 0.05
"""Standard deviation of each component of the normals before they are made unit vectors again."""


@dataclass(frozen=True)
class Case:
    """A scan.

    Parameters
    ----------
    shape : name in `sample_shapes.SHAPES`
    points : how many, drawn uniformly by area from what the holes leave
    noise : standard deviation of each coordinate, in radii
    holes : balls about random places of the surface in which there are no points
    reach : radius of the balls, in radii
    """

    shape: str
    points: int
    noise: float
    holes: int = 0
    reach: float = 0.0

    @property
    def truth(self) -> Shape:
        """The shape itself."""
        return SHAPES[self.shape]


CASES = {
    "bracket, sparse": Case("bracket", 800, 0.001),
    "bracket, noisy": Case("bracket", 1500, 0.006),
    "bracket, holed": Case("bracket", 1500, 0.001, 6, 0.2),
    "bracket, sparse and holed": Case("bracket", 700, 0.0005, 6, 0.25),
    "knot, sparse": Case("knot", 700, 0.001),
    "knot, holed": Case("knot", 1500, 0.002, 6, 0.25),
}


def draw(case: Case, seed: int) -> PointCloud:
    """Return the scan of a case, in millimetres, its own for each seed."""
    rng = np.random.default_rng(seed)
    reference = read_mesh(REPOSITORY / "sample_data" / f"{case.shape}_reference.ply")
    radius = Frame.of(reference.vertices).scale
    # Twice as many, because the holes take their share.
    points = project(case.truth.distance, sample_surface(reference, 2 * case.points, rng).points)
    centres = points[rng.integers(len(points), size=case.holes)]
    away = np.linalg.norm(points[:, None] - centres, axis=2)
    points = points[(away > case.reach * radius).all(axis=1)][: case.points]
    normals = gradient(case.truth.distance, points)
    normals = _unit(_unit(normals) + NORMAL_NOISE * rng.standard_normal(normals.shape))
    return PointCloud(points + case.noise * radius * rng.standard_normal(points.shape), normals)


def errors(case: Case, points: Float) -> Float:
    """Return how far points, of shape (N, 3), lie from the shape, in millimetres, along the gradient."""
    return np.asarray(np.linalg.norm(project(case.truth.distance, points, steps=6) - points, axis=1))


def _unit(vectors: Float) -> Float:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))
