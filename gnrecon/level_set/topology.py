"""Connectedness as a residual: target values of f at a few points, with which components of a solid join.

A component of the solid {f < 0} that is separate from the others (found by persistent homology) can be

- joined to an older one: f at the saddle between them, positive now, should be -m, or
- removed: f at its minimum, negative now, should be +m,

with a small margin m, so that the joining neck has some width. The paper joins all components. If anchors are given,
points to which the solid is attached, only components with an anchor must stay. Of the others, those are removed whose
minimum is nearer to zero than the saddle. The residual is f(x) - target at the points x; both change from step to step,
like the sample of a moving surface.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from gnrecon.geometry.arrays import Float, Int, Mask
from gnrecon.geometry.signed_distance import Box
from gnrecon.level_set.level_set import LevelSet
from gnrecon.level_set.level_set_parameters import LevelSetParameters
from gnrecon.runtime.quiet_imports import import_uninterrupted


@dataclass(frozen=True)
class ConnectionTargets:
    """Points and the values of f there with which the solid would be connected.

    Parameters
    ----------
    points : of shape (K, 3)
    targets : of shape (K,): negative at saddles, positive at minima of components to be removed
    components : current number of components of {f < 0} within the region; 0 if it is empty
    islands : how many of these no path within the region connects to the oldest one
    """

    points: Tensor
    targets: Tensor
    components: int
    islands: int


@dataclass(frozen=True)
class GridRegion:
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
    def within(
        cls, box: Box, inside: Callable[[Float], Mask] | None = None, cells: int = LevelSetParameters.component_cells
    ) -> GridRegion:
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


def joints(level_set: LevelSet, region: GridRegion, margin: float, anchors: Float | None = None) -> ConnectionTargets:
    """Return points and target values with which {f < 0} would be connected within a region.

    Parameters
    ----------
    margin : distance of the targets from zero
    anchors : points, of shape (A, 3), on components that must stay; without any, all components stay and are joined
    """
    values = region.values(level_set)
    separate = separate_components(values)
    removed = np.zeros(len(separate.births), bool) if anchors is None else _removable(values, separate, region, anchors)
    saddles = _critical(level_set, region, separate.deaths[~removed], negative=1)
    minima = _critical(level_set, region, separate.births[removed], negative=0)
    targets = torch.cat([torch.full_like(saddles[:, 0], -margin), torch.full_like(minima[:, 0], margin)])
    return ConnectionTargets(
        torch.cat([saddles, minima]), targets, separate.components, max(len(separate.islands) - 1, 0)
    )


def _critical(level_set: LevelSet, region: GridRegion, nodes: Int, negative: int) -> Tensor:
    return refined(level_set, level_set.tensor(region.points(nodes)), region.spacing, negative)


def _removable(values: Float, separate: SeparateComponents, region: GridRegion, anchors: Float) -> Mask:
    """Return which components have no anchor and are nearer to removal than to joining, of shape (K,)."""
    from scipy.ndimage import label

    labels = label(values < 0)[0]
    needed = np.unique(_labels_near(labels, region, anchors))
    births, deaths = tuple(separate.births.T), tuple(separate.deaths.T)
    removable: Mask = ~np.isin(labels[births], needed) & (-values[births] < values[deaths])
    return removable


def _labels_near(labels: Int, region: GridRegion, anchors: Float) -> Int:
    """Return the labels, zero for none, of all nodes within a cell of the anchors."""
    base = np.floor((anchors - region.lower) / region.spacing).astype(int)
    corners = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), axis=-1).reshape(-1, 3)
    nodes = np.clip(base[:, None] + corners, 0, np.array(labels.shape) - 1).reshape(-1, 3)
    found: Int = labels[tuple(nodes.T)]
    return found


# From the critical nodes of a grid to the critical points of the field itself.
#
# A minimum or saddle among nodes lies within about a cell of one of f, where grad f = 0 and the Hessian has no or one
# negative eigenvalue. Newton's method finds it,
#
#     x  <-  x - H^-1 grad f,
#
# with H by central differences of the gradient, as there are few such points. Steps are capped, and a point is moved
# only if it ends near its node, at a critical point of the right kind. Others stay at their nodes: a saddle at the
# border of a region need not be one of f, and where f is flat no point is better than another.


def refined(
    level_set: LevelSet,
    nodes: Tensor,
    spacing: float,
    negative: int,
    *,
    iterations: int = 12,
    reach_spacings: float = 2.0,
    gradient_ratio: float = 1e-6,
    digits: int = 10,
) -> Tensor:
    """Return the critical points of f, of shape (K, 3), near nodes, (K, 3), of a grid, or the nodes if there are none.

    Parameters
    ----------
    spacing : of the grid
    negative : number of negative eigenvalues of the Hessian: 0 at a minimum, 1 at a saddle
    iterations : Newton steps, each of at most half a spacing
    reach_spacings : largest distance of a critical point from its node
    gradient_ratio : largest |grad f| at a critical point, relative to that at the node
    digits : decimals to which points are rounded; the last digits of the linear solves depend on the memory layout
    """
    if not len(nodes):
        return nodes
    points = nodes.clone()
    for _ in range(iterations):
        gradient, hessian = _derivatives(level_set, points, spacing)
        step = -torch.linalg.lstsq(hessian, gradient[:, :, None]).solution[:, :, 0]
        length = torch.linalg.vector_norm(step, dim=1, keepdim=True)
        points = points + step.nan_to_num() * (spacing / 2 / length.clamp_min(spacing / 2))
    gradient, hessian = _derivatives(level_set, points, spacing)
    slope, before = (torch.linalg.vector_norm(g, dim=1) for g in (gradient, _gradient(level_set, nodes)))
    found = (
        (torch.linalg.vector_norm(points - nodes, dim=1) <= reach_spacings * spacing)
        & (slope <= gradient_ratio * before.clamp_min(torch.finfo(before.dtype).tiny))
        & ((torch.linalg.eigvalsh(hessian) < 0).sum(1) == negative)
    )
    return torch.where(found[:, None], points.round(decimals=digits), nodes)


def _derivatives(level_set: LevelSet, points: Tensor, spacing: float) -> tuple[Tensor, Tensor]:
    """Return grad f, of shape (K, 3), and Hess f, of shape (K, 3, 3)."""
    step = 1e-4 * spacing
    shifts = step * torch.eye(3, dtype=points.dtype, device=points.device)
    columns = [_gradient(level_set, points + s) - _gradient(level_set, points - s) for s in shifts]
    hessian = torch.stack(columns, dim=2) / (2 * step)
    return _gradient(level_set, points), ((hessian + hessian.mT) / 2).nan_to_num()


def _gradient(level_set: LevelSet, points: Tensor) -> Tensor:
    return level_set.values_and_gradients(points)[1].nan_to_num()


# The components of a solid {f < 0} within a region, and the values of f at which they would join.
#
# As the level t rises, the components of {f < t} are born at minima of f and die at saddles, where they meet an older
# one. Zero-dimensional persistent homology pairs the two. On the nodes of a grid, joined along its edges, that is
# the persistence of a cubical filtration, which gudhi computes; nodes outside of the region are infinite, so that no
# path leads through them. A pair with
#
#     birth < 0 < death
#
# is a component of the solid that is not connected to the others: it dies at the lowest saddle on any path to an older
# one.
#
# Sources: Edelsbrunner and Harer, Computational Topology (2010); Wagner, Chen and Vucini, Efficient computation of
# persistent homology for cubical data (2012). The paper and Berzins et al., Geometry-informed neural networks (2024),
# use it for connectedness.


class SeparateComponents(NamedTuple):
    """Components of {f < 0} that are not connected to an older one, which is the one with the lower minimum.

    Parameters
    ----------
    births : node of the minimum of each, of shape (K, 3)
    deaths : node of the saddle at which each would join an older one, of shape (K, 3)
    islands : node of the minimum, (L, 3), of each that no path within the region connects to any; the oldest first
    """

    births: Int
    deaths: Int
    islands: Int

    @property
    def components(self) -> int:
        """Number of components of the solid."""
        return len(self.births) + len(self.islands)


def separate_components(values: Float) -> SeparateComponents:
    """Find the components of {f < 0} on a grid, of shape (I, J, K), infinite outside of the region."""
    gudhi = import_uninterrupted("gudhi")
    from scipy.ndimage import label

    if label(values < 0)[1] == 1:
        # A single component; labelling finds this a hundred times faster than persistence.
        none = np.zeros((0, 3), np.int64)
        return SeparateComponents(none, none, np.argwhere(values == values.min())[:1])
    filtration = gudhi.CubicalComplex(vertices=values)
    filtration.compute_persistence(min_persistence=0.0)
    paired, essential = filtration.vertices_of_persistence_pairs()
    # The lists have an entry for each dimension that occurs; components are of dimension zero.
    births, deaths = _nodes(paired[:1], values.shape).reshape(-1, 2, 3).swapaxes(0, 1)
    islands = _nodes(essential[:1], values.shape).reshape(-1, 3)
    separate = (_at(values, births) < 0) & (_at(values, deaths) >= 0) & np.isfinite(_at(values, deaths))
    lost = (_at(values, births) < 0) & ~np.isfinite(_at(values, deaths))
    islands = np.concatenate([islands[_at(values, islands) < 0], births[lost]])
    return SeparateComponents(
        births[separate], deaths[separate], islands[np.argsort(_at(values, islands), kind="stable")]
    )


def _nodes(numbers: list[Int], shape: tuple[int, ...]) -> Int:
    """Return the nodes, of shape (..., 3), of gudhi's vertex numbers, in which the first axis varies fastest."""
    flat = np.concatenate([np.zeros((0,), np.int64), *(part.ravel() for part in numbers)])
    return np.stack(np.unravel_index(flat, shape, order="F"), axis=-1)


def _at(values: Float, nodes: Int) -> Float:
    found: Float = values[tuple(nodes.T)]
    return found
