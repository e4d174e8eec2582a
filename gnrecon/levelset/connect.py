"""Connectedness as an ordinary residual: values that f should have at few points, so that components join.

For each component of the solid {f < 0} that is apart from the others (`persistence`) there are two ways to mend it:

- join it to an older one: f at the pass between them, positive now, should be -m;
- remove it: f at its minimum, negative now, should be +m,

with a small margin m, so that what is joined is joined by a neck of some width. The paper joins all. Where anchors are
given, points that the solid is attached to, only components that hold one must stay; of the others those are removed
whose minimum has a shorter way to zero than the pass has. The residual is f(x) - target at the points x; both change
from step to step, as the sample of a moving surface does.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gnrecon.geometry.arrays import Float, Int, Mask
from gnrecon.geometry.signed_distance import Box
from gnrecon.levelset.critical import refined
from gnrecon.levelset.level_set import LevelSet
from gnrecon.levelset.persistence import Separate, separate_components

CELLS = 64


@dataclass(frozen=True)
class Joints:
    """Where f should have which value for the solid to be in one piece.

    Parameters
    ----------
    points : of shape (K, 3)
    targets : of shape (K,): negative at passes, positive at minima of what is removed
    components : of {f < 0} within the region, as they are; 0 where it is empty
    islands : of these, how many no way within the region joins to the oldest one
    """

    points: Tensor
    targets: Tensor
    components: int
    islands: int


@dataclass(frozen=True)
class Region:
    """The nodes of a cubic grid that belong to a region.

    Parameters
    ----------
    lower : the first node, of shape (3,)
    spacing : of the nodes
    mask : of shape (I, J, K)
    """

    lower: Float
    spacing: float
    mask: Mask

    @classmethod
    def within(cls, box: Box, inside: Callable[[Float], Mask] | None = None, cells: int = CELLS) -> Region:
        """Return the nodes of a box, `cells` along its longest side, that are `inside`; all of them by default."""
        sides = box.upper - box.lower
        spacing = float(sides.max()) / cells
        counts = np.round(sides / spacing).astype(int) + 1
        nodes = np.stack(np.meshgrid(*(np.arange(n) for n in counts), indexing="ij"), axis=-1)
        points = box.lower + spacing * nodes.reshape(-1, 3)
        mask = np.ones(len(points), bool) if inside is None else inside(points)
        return cls(box.lower, spacing, mask.reshape(counts))

    def points(self, nodes: Int) -> Float:
        """Return the positions of nodes, both of shape (..., 3)."""
        return self.lower + self.spacing * nodes

    def values(self, level_set: LevelSet) -> Float:
        """Return f at the nodes of the region, of shape (I, J, K), infinite at the others."""
        values = np.full(self.mask.shape, np.inf)
        positions = self.points(np.argwhere(self.mask))
        values[self.mask] = level_set.values(level_set.tensor(positions)).cpu().numpy()
        return values


def joints(level_set: LevelSet, region: Region, margin: float, anchors: Float | None = None) -> Joints:
    """Return where f should have which value for {f < 0} to be one piece within a region.

    Parameters
    ----------
    margin : by how much f should lie beyond zero at those points
    anchors : points, of shape (A, 3), on what must stay; without any, all components stay and are joined
    """
    values = region.values(level_set)
    apart = separate_components(values)
    removed = np.zeros(len(apart.births), bool) if anchors is None else _removable(values, apart, region, anchors)
    passes = _critical(level_set, region, apart.deaths[~removed], negative=1)
    minima = _critical(level_set, region, apart.births[removed], negative=0)
    targets = torch.cat([torch.full_like(passes[:, 0], -margin), torch.full_like(minima[:, 0], margin)])
    return Joints(torch.cat([passes, minima]), targets, apart.components, max(len(apart.islands) - 1, 0))


def _critical(level_set: LevelSet, region: Region, nodes: Int, negative: int) -> Tensor:
    return refined(level_set, level_set.tensor(region.points(nodes)), region.spacing, negative)


def _removable(values: Float, apart: Separate, region: Region, anchors: Float) -> Mask:
    """Return which components hold no anchor and are more easily removed than joined, of shape (K,)."""
    from scipy.ndimage import label

    labels = label(values < 0)[0]
    needed = np.unique(_labels_near(labels, region, anchors))
    births, deaths = tuple(apart.births.T), tuple(apart.deaths.T)
    removable: Mask = ~np.isin(labels[births], needed) & (-values[births] < values[deaths])
    return removable


def _labels_near(labels: Int, region: Region, anchors: Float) -> Int:
    """Return the labels, zero for none, of all nodes within a cell of the anchors."""
    base = np.floor((anchors - region.lower) / region.spacing).astype(int)
    corners = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), axis=-1).reshape(-1, 3)
    nodes = np.clip(base[:, None] + corners, 0, np.array(labels.shape) - 1).reshape(-1, 3)
    found: Int = labels[tuple(nodes.T)]
    return found
