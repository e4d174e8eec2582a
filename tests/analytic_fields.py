"""Analytic fields for the exporter's tests, in unit coordinates, behind any frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gnrecon.export import extract, project
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import Frame

Function = Callable[[Float], Float]

UNIT = Frame(np.zeros(3), 1.0)
UTM = Frame(np.array([500_000.0, 4_500_000.0, 100.0]), 20.0)
"""A shape twenty metres in radius, far from its coordinate system's origin."""


@dataclass
class Field:
    """A function of unit coordinates as a `SignedDistance`, its gradient by central differences."""

    function: Function
    reach: float = 1.1
    frame: Frame = UNIT
    asked: int = 0

    @property
    def bounds(self) -> Float:
        return self.frame.to_world(np.array([[-self.reach] * 3, [self.reach] * 3]))

    def sdf(self, points: Float) -> Float:
        self.asked += len(points)
        return self.frame.scale * self.function(self.frame.to_unit(points))

    def gradient(self, points: Float) -> Float:
        unit = self.frame.to_unit(points)
        steps = 1e-6 * np.eye(3)
        return np.stack([(self.function(unit + s) - self.function(unit - s)) / 2e-6 for s in steps], axis=1)


def sphere(radius: float = 0.8, center: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Function:
    return lambda x: np.linalg.norm(x - np.array(center), axis=1) - radius


def ball_mesh(radius: float = 0.8, frame: Frame = UTM, resolution: int = 24, reach: float = 1.1) -> Mesh:
    """A sphere's mesh, its vertices projected onto the sphere."""
    field = Field(sphere(radius), reach, frame)
    return project(extract(field, resolution=resolution), field)


def torus(major: float = 0.6, minor: float = 0.2) -> Function:
    return lambda x: np.hypot(np.hypot(x[:, 0], x[:, 1]) - major, x[:, 2]) - minor


def plate(half_thickness: float = 0.011) -> Function:
    """A box whose distance is the largest over its three slabs."""
    return lambda x: (np.abs(x) - np.array([0.8, 0.7, half_thickness])).max(axis=1)


def union(*functions: Function) -> Function:
    return lambda x: np.min([f(x) for f in functions], axis=0)


def shells() -> Function:
    """A thick shell with a ball in its cavity: outer surface, cavity, and another outer surface within."""
    return lambda x: np.minimum(np.abs(np.linalg.norm(x, axis=1) - 0.8) - 0.1, np.linalg.norm(x, axis=1) - 0.3)


def sines(seed: int, frequency: float = 6.0) -> Function:
    """A random smooth function that has nothing of a distance."""
    rng = np.random.default_rng(seed)
    waves, phases = frequency * rng.normal(size=(12, 3)), rng.uniform(0, 2 * np.pi, 12)
    return lambda x: 0.05 * np.sin(x @ waves.T + phases).sum(axis=1)
