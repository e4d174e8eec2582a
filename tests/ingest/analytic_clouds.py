"""Analytic clouds: points and their true outward normals."""

from __future__ import annotations

import numpy as np
from made_shapes import sphere

from gnrecon.geometry.arrays import Float


def torus(count: int, rng: np.random.Generator, tube: float = 0.3) -> tuple[Float, Float]:
    """Points on a torus around z of radius 1, evenly spread over the area by rejection."""
    u, v, w = rng.uniform(size=(3, 4 * count)) * [[2 * np.pi], [2 * np.pi], [1 + tube]]
    u, v = u[w < 1 + tube * np.cos(v)][:count], v[w < 1 + tube * np.cos(v)][:count]
    normals = np.column_stack([np.cos(u) * np.cos(v), np.sin(u) * np.cos(v), np.sin(v)])
    return np.column_stack([np.cos(u), np.sin(u), np.zeros_like(u)]) + tube * normals, normals


def thin_shell(count: int, rng: np.random.Generator, wall: float = 0.15) -> tuple[Float, Float]:
    """A hollow half-open bowl with a wall so thin that a sparse cloud's nearest neighbours lie across it."""
    outside, _ = sphere(4 * count, rng)
    outside = outside[outside[:, 2] < 0.3][:count]
    inner = rng.uniform(size=len(outside)) < (1 - wall) ** 2 / (1 + (1 - wall) ** 2)
    return np.where(inner[:, None], (1 - wall) * outside, outside), np.where(inner[:, None], -outside, outside)
