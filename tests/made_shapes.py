"""Points of made shapes with their exact normals, drawn by seed: a cube, and a square plate with a round bore."""

from __future__ import annotations

import numpy as np

from gnrecon.geometry.arrays import Float


def cube(count: int, side: float, seed: int = 0) -> tuple[Float, Float]:
    """Draw points of a cube from -side to side."""
    rng = np.random.default_rng(seed)
    axis, sign, rows = rng.integers(3, size=count), rng.choice([-1.0, 1.0], count), np.arange(count)
    x, normals = rng.uniform(-side, side, (count, 3)), np.zeros((count, 3))
    x[rows, axis] = side * sign
    normals[rows, axis] = sign
    return x, normals


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
