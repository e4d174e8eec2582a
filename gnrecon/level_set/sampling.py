"""Uniform samples of a level set.

1. A randomly shifted grid is searched for crossings, each with the area that it represents (`surface_search`).
2. Points are drawn from them in proportion to area, by systematic sampling along a space-filling curve: each part of
   the curve, and so each patch of the surface, gets a number of points in proportion to its area, up to one.
3. They move at random and then repel each other on the surface until they are evenly spaced.
4. Newton's method projects them onto the level set to rounding (`newton_projection`); points that do not converge, near
   a critical point, are dropped.
5. They are ordered so that neighbours are adjacent, which `least_squares.neighbour_sums` uses.

Means over the points approximate means over the surface, and `area` times them its integrals. Nearly all of the cost is
the evaluation of the grid.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gnrecon.geometry.arrays import Float, Int
from gnrecon.geometry.signed_distance import Box, kd_tree_order
from gnrecon.level_set.level_set import LevelSet
from gnrecon.level_set.level_set_parameters import LevelSetParameters
from gnrecon.level_set.newton_projection import newton_step, project
from gnrecon.level_set.surface_search import Crossings, find_crossings


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
    level_set: LevelSet,
    count: int,
    rng: np.random.Generator,
    nodes: int = LevelSetParameters.grid_nodes,
    sweeps: int = 3,
) -> SurfaceSample:
    """Draw about `count` points of a level set, evenly spread.

    Parameters
    ----------
    level_set : LevelSet
    count : number of points; a few less near critical points, and none if the level set is empty
    rng : for the shift of the grid, the choice of points and their random moves
    nodes : evaluations of f for the search; parts smaller than a cell, (volume / nodes)^(1/3), may be missed
    sweeps : rounds of repulsion, each with one evaluation of f and its gradient at the points; 0 gives a random sample
    """
    crossings = find_crossings(level_set, nodes, rng)
    area = float(crossings.areas.sum())
    if not area:
        return SurfaceSample(crossings.points, crossings.normals, 0.0)
    chosen = torch.as_tensor(systematic(crossings, level_set.box, count, rng)).to(level_set.device)
    points, normals = crossings.points[chosen], crossings.normals[chosen]
    spacing = float(np.sqrt(area / count))
    points, normals = random_move(level_set, points, normals, max(crossings.spacing, spacing) / 2, rng)
    for _ in range(sweeps):
        points, normals = repel(level_set, points, normals, spacing)
    return _projected_sample(level_set, points, crossings.spacing, area)


def systematic(crossings: Crossings, box: Box, count: int, rng: np.random.Generator) -> Int:
    """Return `count` row numbers of crossings, drawn by their areas at equal steps along a space-filling curve."""
    order = np.argsort(_curve(crossings.points.cpu().numpy(), box), kind="stable")
    reached = np.cumsum(crossings.areas.cpu().numpy()[order])
    marks = (np.arange(count) + rng.uniform()) * (reached[-1] / count)
    chosen: Int = order[np.minimum(np.searchsorted(reached, marks), len(order) - 1)]
    return chosen


def _curve(points: Float, box: Box) -> Int:
    """Return the Morton code of each point, of shape (N, 3), with 1,024 cells along each axis, of shape (N,)."""
    cells = ((points - box.lower) / (box.upper - box.lower) * 1023).astype(np.int64)
    place = np.zeros(len(points), np.int64)
    for bit in range(10):
        for axis in range(3):
            place |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return place


def _projected_sample(level_set: LevelSet, points: Tensor, cap: float, area: float) -> SurfaceSample:
    """Project the points and keep those that converge within the box."""
    projected = project(level_set, points, cap)
    kept = (projected.converged & level_set.contains(projected.points)).nonzero()[:, 0]
    kept = kept[torch.as_tensor(kd_tree_order(projected.points[kept].cpu().numpy())).to(kept.device)]
    return SurfaceSample(projected.points[kept], torch.nn.functional.normalize(projected.gradients[kept], dim=1), area)


PointsAndNormals = tuple[Tensor, Tensor]
"""Points near the level set and unit normals there, both of shape (N, 3)."""


# Moving points on a level set until they are evenly spaced: two moves in the tangent plane, each followed by one Newton
# step back onto the surface.
#
# *Random move.* A symmetric random displacement; a point that would leave the box stays. This is a Metropolis step with
# uniform stationary distribution (symmetric to second order in step times curvature), so points drawn uniformly from
# the crossings of a grid stay uniform and lose the pattern of the grid.
#
# *Repel.* Each point x is pushed by its neighbours y within the range s,
#
#     sum over y of (1 - |x - y| / s)^2 (x - y) / |x - y|,
#
# which lowers the density where it is above its surroundings. Without a counterforce points would gather at the faces
# of the box, so each point near a face has a mirror image behind it.
# Compare Witkin and Heckbert, Using particles to sample and control implicit surfaces (SIGGRAPH 1994).


def random_move(
    level_set: LevelSet, points: Tensor, normals: Tensor, length: float, rng: np.random.Generator
) -> PointsAndNormals:
    """Return points, of shape (N, 3), displaced at random in their tangent planes, by `length` in the root mean square.

    Points stay if the move leaves the box, or does not end within `length` of the level set.
    """
    moves = level_set.tensor(rng.standard_normal((len(points), 3)) * (length / np.sqrt(2)))
    return _moved(level_set, points, normals, tangential(moves, normals), length)


def repel(
    level_set: LevelSet,
    points: Tensor,
    normals: Tensor,
    spacing: float,
    *,
    range_spacings: float = 1.8,
    push_spacings: float = 0.6,
) -> PointsAndNormals:
    """Return points, of shape (N, 3), moved away from their neighbours, by less than the mean `spacing`.

    Parameters
    ----------
    range_spacings : distance within which points repel each other
    push_spacings : length of the push of a neighbour in the same place
    """
    push = push_spacings * spacing * repulsion(points.cpu().numpy(), level_set.box, range_spacings * spacing)
    moves = tangential(level_set.tensor(push), normals)
    length = torch.linalg.vector_norm(moves, dim=1, keepdim=True)
    limit = spacing / 2
    return _moved(level_set, points, normals, moves * (limit / length.clamp_min(limit)), spacing)


def repulsion(points: Float, box: Box, reach: float, *, neighbours: int = 8) -> Float:
    """Return the push on each point, of shape (N, 3), from its nearest neighbours and from mirror images of points."""
    from scipy.spatial import cKDTree

    if len(points) < 2:
        return np.zeros_like(points)
    sources = np.concatenate([points, *_mirrored(points, box, reach)])
    count = min(neighbours, len(sources) - 1)
    # The first neighbour is the point itself, or another one in the same place, which does not push either.
    distances, rows = cKDTree(sources).query(points, count + 1, distance_upper_bound=reach)
    away = points[:, None] - sources[np.minimum(rows, len(sources) - 1)]
    near = np.isfinite(distances) & (distances > 0)
    strength = np.where(near, np.clip(1 - np.where(near, distances, reach) / reach, 0, None) ** 2, 0)
    push: Float = ((strength / np.where(near, distances, 1.0))[..., None] * away).sum(axis=1)
    return push


def tangential(vectors: Tensor, normals: Tensor) -> Tensor:
    """Return the parts of vectors, of shape (N, 3), that are orthogonal to unit normals, of shape (N, 3)."""
    return vectors - (vectors * normals).sum(1, keepdim=True) * normals


def _moved(level_set: LevelSet, points: Tensor, normals: Tensor, moves: Tensor, cap: float) -> PointsAndNormals:
    """Return points moved and brought back to the level set by one Newton step, where that stays in the box."""
    tried = newton_step(level_set, points + moves, cap)
    good = (level_set.contains(tried.points) & (tried.distances.abs() <= cap))[:, None]
    # The gradient before the last, short step is accurate enough for the tangent plane.
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
