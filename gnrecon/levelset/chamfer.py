"""The paper's Chamfer divergence between a level set and a known surface, by projection.

The paper defines (its appendix on the Chamfer divergence)

    CD_1(P, Q)^2 = (1 / |Q|) sum over x in Q of min over y in P of |x - y|^2

and finds the nearest y not among samples of P, whose spacing would drown the result, but by projecting x onto P. Here
P is the level set and Q the known surface, of which points with their shares of the area stand for all:

    CD_1 = sqrt(sum_i a_i |x_i - y(x_i)|^2),      y(x) the nearest point of the level set.

Two starts are tried for each nearest point (`newton.nearest`): x itself, right where the surfaces agree, and the
nearest of many points of the level set, right where they do not. Where neither arrives, the latter counts as it is.

The other direction, from the level set to the known surface (`to_known`), sees what the first cannot: sheets that the
level set has and the known surface has not. A level set goes on where a patch ends, so only those of its points count
whose foot lies inside the patch.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gnrecon.levelset.known_surface import KnownSurface
from gnrecon.levelset.level_set import LevelSet
from gnrecon.levelset.newton import nearest
from gnrecon.levelset.sample import SurfaceSample, sample_surface

_COUNT = 4000
_STARTS = 10_000


@dataclass(frozen=True)
class ChamferDivergence:
    """Root mean square distances, in the coordinates' unit; infinite where the level set is empty.

    Parameters
    ----------
    from_known : CD_1, from points of the known surface to the level set: the paper's figure
    to_known : from points of the level set, whose foot is in the patch, to the known surface
    """

    from_known: float
    to_known: float


def chamfer_divergence(
    level_set: LevelSet, known: KnownSurface, rng: np.random.Generator, count: int = _COUNT
) -> ChamferDivergence:
    """Measure a level set against a known surface within its box, each by `count` points of the other.

    Parameters
    ----------
    level_set : on the CPU
    rng : draws the sample of the level set
    """
    sample = sample_surface(level_set, max(_STARTS, count), rng)
    if not len(sample):
        return ChamferDivergence(float("inf"), float("inf"))
    points, shares = known.sample(count)
    distances = distances_to(level_set, points, sample)
    return ChamferDivergence(float((shares * distances.square()).sum().sqrt()), _to_known(sample, known, count))


def distances_to(level_set: LevelSet, queries: Tensor, sample: SurfaceSample) -> Tensor:
    """Return the distances, of shape (N,), of queries, (N, 3), from the level set, of which `sample` has points."""
    from scipy.spatial import cKDTree

    distances, rows = cKDTree(sample.points.numpy()).query(queries.numpy())
    least = torch.as_tensor(distances)
    cap = level_set.diagonal / 20
    for starts in (sample.points[torch.as_tensor(rows)], queries):
        feet = nearest(level_set, queries, starts, cap)
        arrived = feet.converged & level_set.contains(feet.points)
        found = torch.linalg.vector_norm(feet.points - queries, dim=1)
        least = torch.where(arrived, torch.minimum(least, found), least)
    return least


def _to_known(sample: SurfaceSample, known: KnownSurface, count: int) -> float:
    # The sample is ordered along a curve through space, so that every n-th point is as even a sample.
    points = sample.points[:: max(1, len(sample) // count)]
    feet, inside = known.nearest(points)
    squares = (feet - points).square().sum(1)[inside]
    return float(squares.mean().sqrt()) if len(squares) else float("inf")
