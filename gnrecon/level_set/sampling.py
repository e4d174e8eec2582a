"""A uniform sample of a level set, drawn afresh whenever the function has changed.

1. A grid, shifted at random, is searched for crossings, each with its share of the area (`crossings`).
2. Points are drawn from them in proportion to those shares, systematically along a space-filling curve: each stretch
   of the curve, and so each patch of the surface, gets the number that its area deserves, up to one.
3. They walk and repel each other on the surface until they are spread evenly (`spread`).
4. Newton's method brings them onto the level set as precisely as rounding allows (`newton`); what does not arrive
   there, near a critical point, is dropped.
5. They are put in an order in which neighbours come together, for those who make use of it (`linalg.neighbours`).

Means over the points then are means over the surface, and `area` times them its integrals. The evaluation of the grid
is nearly all of the cost.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gnrecon.geometry.arrays import Float, Int
from gnrecon.geometry.signed_distance import Box, kd_tree_order
from gnrecon.level_set.level_set import LevelSet
from gnrecon.level_set.surface_search import Crossings, find_crossings, newton_step, project

NODES = 100_000

_SWEEPS = 3


@dataclass(frozen=True)
class SurfaceSample:
    """Points of a level set, uniform by area; none where the level set is empty.

    Parameters
    ----------
    points : of shape (N, 3), on the level set and in the box, in `kd_tree_order`
    normals : grad f / |grad f| there, of shape (N, 3)
    area : an unbiased estimate of the surface's area in the box, in squared units of the coordinates
    """

    points: Tensor
    normals: Tensor
    area: float

    def __len__(self) -> int:
        return len(self.points)


def sample_surface(
    level_set: LevelSet, count: int, rng: np.random.Generator, nodes: int = NODES, sweeps: int = _SWEEPS
) -> SurfaceSample:
    """Draw about `count` points of a level set, evenly spread.

    Parameters
    ----------
    level_set : LevelSet
    count : number of points; those that meet a critical point are left out, and none are found on an empty level set
    rng : draws the grid's shift, the points and their walk
    nodes : evaluations of f that the search may cost; parts smaller than a cell, (volume / nodes)^(1/3), may be missed
    sweeps : rounds of repulsion, each of one evaluation of f and its gradient at the points; 0 leaves a random sample
    """
    crossings = find_crossings(level_set, nodes, rng)
    area = float(crossings.areas.sum())
    if not area:
        return SurfaceSample(crossings.points, crossings.normals, 0.0)
    chosen = torch.as_tensor(systematic(crossings, level_set.box, count, rng)).to(level_set.device)
    points, normals = crossings.points[chosen], crossings.normals[chosen]
    spacing = float(np.sqrt(area / count))
    points, normals = walk(level_set, points, normals, max(crossings.spacing, spacing) / 2, rng)
    for _ in range(sweeps):
        points, normals = repel(level_set, points, normals, spacing)
    return _arrived(level_set, points, crossings.spacing, area)


def systematic(crossings: Crossings, box: Box, count: int, rng: np.random.Generator) -> Int:
    """Return `count` row numbers of crossings, drawn by their areas at equal steps along a space-filling curve."""
    order = np.argsort(_curve(crossings.points.cpu().numpy(), box), kind="stable")
    reached = np.cumsum(crossings.areas.cpu().numpy()[order])
    marks = (np.arange(count) + rng.uniform()) * (reached[-1] / count)
    chosen: Int = order[np.minimum(np.searchsorted(reached, marks), len(order) - 1)]
    return chosen


def _curve(points: Float, box: Box) -> Int:
    """Return the place of each point, of shape (N, 3), along Morton's curve of 1,024 cells a side, of shape (N,)."""
    cells = ((points - box.lower) / (box.upper - box.lower) * 1023).astype(np.int64)
    place = np.zeros(len(points), np.int64)
    for bit in range(10):
        for axis in range(3):
            place |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return place


def _arrived(level_set: LevelSet, points: Tensor, cap: float, area: float) -> SurfaceSample:
    """Project the points and keep those that arrive, within the box."""
    projected = project(level_set, points, cap)
    kept = (projected.converged & level_set.contains(projected.points)).nonzero()[:, 0]
    kept = kept[torch.as_tensor(kd_tree_order(projected.points[kept].cpu().numpy())).to(kept.device)]
    return SurfaceSample(projected.points[kept], torch.nn.functional.normalize(projected.gradients[kept], dim=1), area)


_RANGE, _PUSH = 1.8, 0.6

_NEIGHBOURS = 8

Spread = tuple[Tensor, Tensor]
"""Points near the level set and unit normals there, both of shape (N, 3)."""


# Spreading points evenly over a level set without leaving it.
#
# Two moves, each along the tangent plane and followed by one Newton step back onto the surface.
#
# *Walk.* A symmetric random displacement; a point that would leave the box stays. That is a Metropolis walk whose
# stationary distribution is the uniform one (symmetric to second order in step times curvature), so points that were
# drawn uniformly from the crossings of a grid stay uniform and lose all trace of the grid.
#
# *Repel.* Each point x is pushed by its neighbours y within the range s,
#
#     sum over y of (1 - |x - y| / s)^2 (x - y) / |x - y|,
#
# which lowers the density where it is above its surroundings. A border of the box would see points gather on it, for
# nothing pushes back from outside: so each point near a face of the box has a mirror image beyond it, which does.
# Compare Witkin and Heckbert, Using particles to sample and control implicit surfaces (SIGGRAPH 1994).
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
