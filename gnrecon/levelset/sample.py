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
from gnrecon.geometry.signed_distance import Box, halved
from gnrecon.levelset.crossings import Crossings, find_crossings
from gnrecon.levelset.level_set import LevelSet
from gnrecon.levelset.newton import project
from gnrecon.levelset.spread import repel, walk

NODES = 100_000
_SWEEPS = 3


@dataclass(frozen=True)
class SurfaceSample:
    """Points of a level set, uniform by area; none where the level set is empty.

    Parameters
    ----------
    points : of shape (N, 3), on the level set and in the box, in the order of `gnrecon.geometry.signed_distance.halved`
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
    kept = kept[torch.as_tensor(halved(projected.points[kept].cpu().numpy())).to(kept.device)]
    return SurfaceSample(projected.points[kept], torch.nn.functional.normalize(projected.gradients[kept], dim=1), area)
