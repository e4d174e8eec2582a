"""Points of simple shapes with their exact normals, drawn by a seed or a generator."""

from __future__ import annotations

import numpy as np

from gnrecon.geometry.arrays import Float

Seed = int | np.random.Generator


def sphere(count: int, seed: Seed = 0, radius: float = 1.0, noise: float | None = None) -> tuple[Float, Float]:
    """Draw points uniform on a sphere, moved along their normals by noise if there is any."""
    rng = np.random.default_rng(seed)
    normals = rng.standard_normal((count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    moved = 0.0 if noise is None else noise * rng.standard_normal((count, 1))
    return normals * (radius + moved), normals


def cube(count: int, side: float, seed: Seed = 0, noise: float | None = None) -> tuple[Float, Float]:
    """Draw points of a cube from -side to side, moved along their normals by noise if there is any."""
    rng = np.random.default_rng(seed)
    axis, sign, rows = rng.integers(3, size=count), rng.choice([-1.0, 1.0], count), np.arange(count)
    x, normals = rng.uniform(-side, side, (count, 3)), np.zeros((count, 3))
    x[rows, axis] = side * sign + (0.0 if noise is None else noise * rng.standard_normal(count))
    normals[rows, axis] = sign
    return x, normals


def off_cube(x: Float, side: float) -> Float:
    """Return the distance to the surface of a cube from -side to side."""
    outside = np.abs(x) - side
    return np.asarray(np.abs(np.linalg.norm(np.maximum(outside, 0), axis=1) + np.minimum(outside.max(axis=1), 0)))


def torus(count: int, seed: Seed, radius: float, tube: float) -> tuple[Float, Float]:
    """Draw points of a torus around z, uniform in both angles."""
    u, v = np.random.default_rng(seed).uniform(0, 2 * np.pi, (2, count))
    normals = np.column_stack([np.cos(u) * np.cos(v), np.sin(u) * np.cos(v), np.sin(v)])
    return radius * np.column_stack([np.cos(u), np.sin(u), np.zeros(count)]) + tube * normals, normals


def box(count: int, rng: np.random.Generator, sides: tuple[float, float, float]) -> tuple[Float, Float]:
    """Draw points uniform on a box around the origin."""
    half = np.array(sides) / 2
    areas = half[[1, 2, 0]] * half[[2, 0, 1]]
    axis, sign = rng.choice(3, count, p=areas / areas.sum()), rng.choice([-1.0, 1.0], count)
    points, normals, rows = rng.uniform(-half, half, (count, 3)), np.zeros((count, 3)), np.arange(count)
    points[rows, axis], normals[rows, axis] = sign * half[axis], sign
    return points, normals


def bored_plate(count: int, side: float, height: float, bore: float, seed: int = 0) -> tuple[Float, Float]:
    """Draw points of a plate from -side to side, -height to height, with a bore of a radius through its middle."""
    rng = np.random.default_rng(seed)
    areas = np.array([2 * (4 * side**2 - np.pi * bore**2), 16 * side * height, 4 * np.pi * bore * height])
    faces, rim, wall = rng.multinomial(count, areas / areas.sum())
    x = rng.uniform(-side, side, (9 * faces, 3))
    x = x[np.hypot(x[:, 0], x[:, 1]) > bore][:faces]
    normals = np.zeros_like(x)
    normals[:, 2] = rng.choice([-1.0, 1.0], len(x))
    x[:, 2] = height * normals[:, 2]
    angle = rng.uniform(0, 2 * np.pi, wall)
    around = np.stack([np.cos(angle), np.sin(angle), np.zeros(wall)], axis=1)
    inner = bore * around + [0, 0, 1] * rng.uniform(-height, height, (wall, 1))
    outer, theirs = rng.uniform(-side, side, (rim, 3)), np.zeros((rim, 3))
    outer[:, 2] *= height / side
    sign, axis = rng.choice([-1.0, 1.0], rim), rng.integers(2, size=rim)
    theirs[np.arange(rim), axis] = sign
    outer[np.arange(rim), axis] = side * sign
    return np.concatenate([x, inner, outer]), np.concatenate([normals, -around, theirs])
