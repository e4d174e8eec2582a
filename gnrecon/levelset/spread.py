"""Spreading points evenly over a level set without leaving it.

Two moves, each along the tangent plane and followed by one Newton step back onto the surface.

*Walk.* A symmetric random displacement; a point that would leave the box stays. That is a Metropolis walk whose
stationary distribution is the uniform one (symmetric to second order in step times curvature), so points that were
drawn uniformly from the crossings of a grid stay uniform and lose all trace of the grid.

*Repel.* Each point x is pushed by its neighbours y within the range s,

    sum over y of (1 - |x - y| / s)^2 (x - y) / |x - y|,

which lowers the density where it is above its surroundings. A border of the box would see points gather on it, for
nothing pushes back from outside: so each point near a face of the box has a mirror image beyond it, which does.
Compare Witkin and Heckbert, Using particles to sample and control implicit surfaces (SIGGRAPH 1994).
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from gnrecon.geometry.arrays import Float
from gnrecon.geometry.signed_distance import Box
from gnrecon.levelset.level_set import LevelSet
from gnrecon.levelset.newton import newton_step

_RANGE, _PUSH = 1.8, 0.6
_NEIGHBOURS = 8


Spread = tuple[Tensor, Tensor]
"""Points near the level set and unit normals there, both of shape (N, 3)."""


def walk(level_set: LevelSet, points: Tensor, normals: Tensor, length: float, rng: np.random.Generator) -> Spread:
    """Return points, of shape (N, 3), displaced at random in their tangent planes, by `length` in the root mean square.

    Points stay where they are if the way leads out of the box, or not back to the level set within `length`.
    """
    moves = level_set.tensor(rng.standard_normal((len(points), 3)) * (length / np.sqrt(2)))
    return _moved(level_set, points, normals, tangential(moves, normals), length)


def repel(level_set: LevelSet, points: Tensor, normals: Tensor, spacing: float) -> Spread:
    """Return points, of shape (N, 3), moved away from their neighbours, by less than the mean `spacing`."""
    push = _PUSH * spacing * repulsion(points.cpu().numpy(), level_set.box, _RANGE * spacing)
    moves = tangential(level_set.tensor(push), normals)
    length = torch.linalg.vector_norm(moves, dim=1, keepdim=True)
    limit = spacing / 2
    return _moved(level_set, points, normals, moves * (limit / length.clamp_min(limit)), spacing)


def repulsion(points: Float, box: Box, reach: float) -> Float:
    """Return the push on each point, of shape (N, 3), from its nearest neighbours and from mirror images of points."""
    from scipy.spatial import cKDTree

    if len(points) < 2:
        return np.zeros_like(points)
    sources = np.concatenate([points, *_mirrored(points, box, reach)])
    count = min(_NEIGHBOURS, len(sources) - 1)
    # The first neighbour is the point itself, unless another one lies in the same place, which pushes nowhere either.
    distances, neighbours = cKDTree(sources).query(points, count + 1, distance_upper_bound=reach)
    away = points[:, None] - sources[np.minimum(neighbours, len(sources) - 1)]
    near = np.isfinite(distances) & (distances > 0)
    strength = np.where(near, np.clip(1 - np.where(near, distances, reach) / reach, 0, None) ** 2, 0)
    push: Float = ((strength / np.where(near, distances, 1.0))[..., None] * away).sum(axis=1)
    return push


def tangential(vectors: Tensor, normals: Tensor) -> Tensor:
    """Return the parts of vectors, of shape (N, 3), that are orthogonal to unit normals, of shape (N, 3)."""
    return vectors - (vectors * normals).sum(1, keepdim=True) * normals


def _moved(level_set: LevelSet, points: Tensor, normals: Tensor, moves: Tensor, cap: float) -> Spread:
    """Return points moved and brought back to the level set by one Newton step, where that stays in the box."""
    tried = newton_step(level_set, points + moves, cap)
    good = (level_set.contains(tried.points) & (tried.distances.abs() <= cap))[:, None]
    # The gradient of before the last, short step is as good a normal as a tangent plane needs.
    turned = torch.nn.functional.normalize(tried.gradients, dim=1)
    return torch.where(good, tried.points, points), torch.where(good, turned, normals)


def _mirrored(points: Float, box: Box, reach: float) -> list[Float]:
    """Return the mirror images, beyond each face of the box, of the points within `reach` of it."""
    images = []
    for axis in range(3):
        for face in (box.lower[axis], box.upper[axis]):
            image = points[np.abs(points[:, axis] - face) < reach].copy()
            image[:, axis] = 2 * face - image[:, axis]
            images.append(image)
    return images
