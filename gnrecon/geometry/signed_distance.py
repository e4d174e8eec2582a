"""Coarse signed distance to an oriented point cloud, and the points at which a field is sampled.

The sign is that of the generalised winding number w(x) = sum_j a_j n_j . (p_j - x) / (4 pi |p_j - x|^3), with a_j the
area that point j represents: x is inside where w > 1/2. Holes and open scans are closed much as by a soap film. The
sign is right wherever x is farther from the surface than the points are from each other, where the sign by nearest
normals often is not. Source: Barill et al., *Fast Winding Numbers for Soups and Clouds* (2018).

The size follows from the distance d to the nearest point. Where each point represents a disk of radius rho, the nearest
point of a random sample lies rho away from the foot of x in the root mean square, so the distance to the surface is
about sqrt(d^2 - rho^2). It is unknown within 2 rho of the points.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch

from gnrecon.geometry.arrays import Float, Int, Mask
from gnrecon.geometry.open_scenes import WindingLevel, sheet_dipoles
from gnrecon.runtime.chunks import slices
from gnrecon.runtime.parallel import map_in_threads


@dataclass(frozen=True)
class Box:
    """An axis-aligned box, unit coordinates."""

    lower: Float
    upper: Float

    @classmethod
    def around(cls, points: Float, margin: float) -> Box:
        """Return the bounding box of `points`, of shape (N, 3), widened by `margin` on each side."""
        return cls(points.min(axis=0) - margin, points.max(axis=0) + margin)

    def holds(self, points: Float, reach: Float | float = 0.0) -> Mask:
        """Return whether points, of shape (N, 3), and all within `reach` of them along each axis, are in the box."""
        inside: Mask = np.all((points - reach >= self.lower) & (points + reach <= self.upper), axis=1)
        return inside

    def nearest(self, points: Float) -> tuple[Float, Float]:
        """Return the nearest points of the box, of shape (N, 3), and the distances to them, of shape (N,).

        Where a point is not a number, so is its distance, and its nearest point is a corner.
        """
        if self.holds(points).all():  # as in nearly all calls
            return points, np.zeros(len(points))
        known = np.where(np.isnan(points).any(axis=1, keepdims=True), self.lower, points)
        near = np.clip(known, self.lower, self.upper)
        return near, np.linalg.norm(points - near, axis=1)

    def sample(self, count: int, rng: np.random.Generator) -> Float:
        """Return uniform points, of shape (count, 3)."""
        return rng.uniform(self.lower, self.upper, (count, 3))


def continued_values(values: Float, beyond: Float) -> Float:
    """Return distances outside of a box that holds the whole surface.

    Parameters
    ----------
    values : array of shape (N,), at the nearest points of the box
    beyond : array of shape (N,), distances to these
    """
    return np.where(beyond == 0.0, values, np.maximum(values, 0.0) + beyond) if beyond.any() else values


def continued(values: Float, gradients: Float, away: Float, beyond: Float) -> tuple[Float, Float]:
    """Return `continued_values` and their gradients; `gradients` and `away`, the way there, have the shape (N, 3)."""
    if beyond.any():
        out = beyond != 0.0
        # The nearest point of the box moves with a point along the axes along which the point is within.
        along = np.where((values > 0.0)[:, None] & (away == 0.0), gradients, 0.0)
        gradients = np.where(out[:, None], along + away / np.where(out, beyond, 1.0)[:, None], gradients)
    return continued_values(values, beyond), gradients


def kd_tree_order(points: Float, *, leaf_points: int = 4) -> Int:
    """Return an order of points, of shape (N, 3), in which any aligned run of 4, 8, 16 ... of them is a compact patch.

    It is the order of a balanced k-d tree: groups are halved across their longest side, the first half a power of two.

    Parameters
    ----------
    points : array of shape (N, 3)
    leaf_points : size of the groups that are not halved further; the shortest runs in use are of four
    """
    points = np.asarray(points)
    rows = np.arange(len(points))
    order = rows
    size = 1 << max(len(points) - 1, 0).bit_length()
    while size > leaf_points:
        ordered, group = points[order], rows // size
        lower = np.minimum.reduceat(ordered, rows[::size])
        sides = np.maximum.reduceat(ordered, rows[::size]) - lower
        longest = sides.argmax(axis=1)
        place = (ordered - lower[group])[rows, longest[group]]
        # The order of groups is kept; the points of each are sorted along its longest side.
        order = order[np.argsort(group + 0.5 * place / np.maximum(sides.max(axis=1), np.finfo(float).tiny)[group])]
        size //= 2
    return order


def sample_near_surface(points: Float, spread: float, count: int, rng: np.random.Generator) -> Float:
    """Return `count` points, of shape (count, 3): data points plus normal noise of standard deviation `spread`."""
    return points[rng.integers(len(points), size=count)] + spread * rng.standard_normal((count, 3))


def free_space_bounds(signed: Float, most: float, *, steepness: float = 0.3) -> Float:
    """Return the least values, of shape (Q,), that a field should have in free space, with the sign of the distance.

    Parameters
    ----------
    signed : signed distances, of shape (Q,)
    most : upper limit of the magnitude: far from the surface only the sign matters
    steepness : magnitude as a share of the distance, well below the slope 1 of a distance
    """
    bounds: Float = np.sign(signed) * np.minimum(steepness * np.abs(signed), most)
    return bounds


@dataclass(frozen=True)
class Density:
    """Local density of points; all properties are computed on first use.

    Parameters
    ----------
    points : array of shape (N, 3)
    neighbours : number of neighbours that determine the area that a point represents
    """

    points: Float
    neighbours: int = 8

    @cached_property
    def tree(self) -> Any:
        """A `scipy.spatial.cKDTree` of the points."""
        from scipy.spatial import cKDTree

        return cKDTree(self.points)

    @cached_property
    def spacing(self) -> float:
        """Median distance between a point and its nearest neighbour."""
        return float(np.median(self.tree.query(self.points, k=2)[0][:, 1]))

    @cached_property
    def disks(self) -> Float:
        """Radius of the disk that each point represents, of shape (N,): 1/k of the area up to its k-th neighbour."""
        k = min(self.neighbours, len(self.points) - 1)
        radii: Float = self.tree.query(self.points, k + 1)[0][:, -1] / np.sqrt(k)
        return radii

    @cached_property
    def radius(self) -> float:
        """Median radius of the disks."""
        return float(np.median(self.disks))


class CoarseDistance:
    """Approximate signed distance to a cloud, negative inside; its sign is reliable beyond the points' spacing.

    Parameters
    ----------
    points, normals : arrays of shape (N, 3), unit coordinates, outward unit normals
    rng : draws the points that the winding number sums over
    density : of the points, if it is known already
    may_be_open : whether the sides of an open scene are found as in `gnrecon.geometry.open_scenes`
    max_sources : number of these points at most, which bounds the cost of a sum
    """

    def __init__(
        self,
        points: Float,
        normals: Float,
        rng: np.random.Generator,
        density: Density | None = None,
        *,
        may_be_open: bool = False,
        max_sources: int = 4000,
    ) -> None:
        self._density = density or Density(points)
        self.spacing = self._density.spacing
        chosen = np.sort(rng.permutation(len(points))[:max_sources])
        self._sources = points[chosen]
        directions, self._radii, self._level = normals[chosen], Density(self._sources).disks, WindingLevel()
        if may_be_open:
            directions, self._radii, self._level = scene_dipoles(self._sources, directions, self._radii)
        self._dipoles = directions * (self._radii**2 / 4)[:, None]

    @property
    def radius(self) -> float:
        """Median radius of the disks that points represent."""
        return self._density.radius

    def sample(self, x: Float) -> tuple[Float, Float]:
        """Return the points among x, of shape (Q, 3), where the distance is known, and the distances there."""
        known, signed, *_ = self.at(x)
        return x[known], signed

    def at(self, x: Float, clear: float = 2.0) -> tuple[Mask, Float, Float, Float]:
        """Return signed distances at those points x, of shape (Q, 3), where they are known.

        Parameters
        ----------
        x : array of shape (Q, 3)
        clear : least distance to the nearest point, in radii of its disk; nearer by, sqrt(d^2 - rho^2) has large errors

        Returns
        -------
        The mask, of shape (Q,), of these points; and for them the signed distances, the distances to the nearest data
        point, and the winding numbers.
        """
        known, size, nearest = self.size(x, clear)
        winding = self.winding_number(x[known])
        return known, sign_of_winding(winding) * size, nearest, winding

    def size(self, x: Float, clear: float = 2.0) -> tuple[Mask, Float, Float]:
        """Return the first three results of `at` with unsigned distances, which is much faster."""
        # One worker: with several, Ctrl-C frees arrays that scipy's threads still use, and the process crashes.
        nearest, rows = self._density.tree.query(x)
        disks = self._density.disks[rows]
        known = nearest > clear * disks
        nearest, disks = nearest[known], disks[known]
        return known, np.sqrt(nearest**2 - disks**2), nearest

    def sign(self, x: Float) -> Float:
        """Return the sign of the distance, of shape (Q,), at x, of shape (Q, 3)."""
        return sign_of_winding(self.winding_number(x))

    def winding_number(self, x: Float) -> Float:
        """Return w, of shape (Q,), at points x, of shape (Q, 3), such that 1/2 divides inside from outside."""
        # With so few sources, disks are large enough for single precision.
        found = winding_number(x, self._sources, self._dipoles, self._radii, torch.float32)
        return self._level.centred(found, self._density.tree.query(x)[0]) if self._level.is_open else found


def scene_dipoles(
    points: Float, normals: Float, disks: Float, *, max_sources: int = 4000, max_queries: int = 400
) -> tuple[Float, Float, WindingLevel]:
    """Return the directions and disks that points represent, and the winding number's level; see `open_scenes`.

    Parameters
    ----------
    points, normals : arrays of shape (N, 3), unit coordinates, outward unit normals
    disks : array of shape (N,), radius of the disk that each point represents
    max_sources, max_queries : random points that the sum runs over, and at which it is evaluated
    """
    chosen = np.random.default_rng(0).permutation(len(points))[:max_sources]
    if len(chosen) < 3:
        return normals, disks, WindingLevel()
    sources, radii = points[chosen], Density(points[chosen]).disks
    dipoles = normals[chosen] * (radii**2 / 4)[:, None]
    level = WindingLevel.at_points(winding_number(sources[:max_queries], sources, dipoles, radii))
    return (*sheet_dipoles(points, normals, disks), level) if level.is_open else (normals, disks, level)


def sign_of_winding(winding: Float) -> Float:
    """Return the sign of the distance, of shape (Q,), for winding numbers: negative inside."""
    return np.where(winding > 0.5, -1.0, 1.0)


def is_sign_certain(winding: Float, *, margin: float = 0.25) -> Mask:
    """Return where winding numbers, of shape (Q,), determine the sign: where they differ from 1/2 by the margin.

    Across a hole the winding number passes through 1/2 slowly; the margin is half of the way to 0 or 1.
    """
    return np.asarray(np.abs(winding - 0.5) > margin)


def film_distance(signed: Float, winding: Float) -> Float:
    """Return signed distances of the surface that closes holes as a film, of shape (Q,), from those of the data.

    Next to a hole the data is farther away than the film, on which the winding number w is 1/2. The film is at a share
    |1 - 2 w| of the data's distance: exactly so above the middle of a round hole in a plane, and on the film.
    """
    return np.minimum(np.abs(1.0 - 2.0 * winding), 1.0) * signed


def winding_number(
    x: Float,
    sources: Float,
    dipoles: Float,
    radii: Float,
    dtype: torch.dtype = torch.float64,
    *,
    batch_terms: int = 1 << 18,
    least_batch: int = 64,
) -> Float:
    """Return the winding number w, of shape (Q,), of dipoles at points x, of shape (Q, 3).

    Parameters
    ----------
    x : array of shape (Q, 3)
    sources : array of shape (J, 3), positions of the dipoles
    dipoles : array of shape (J, 3), each a normal times its area, over 4 pi
    radii : array of shape (J,), of disks of these areas; within its disk a term is bounded
    dtype : of the terms; single precision is several times faster, and accurate enough for radii above 1e-3 of the
        coordinates
    batch_terms : of a matrix product, which fit into the processor's cache
    least_batch : points of one
    """
    # sum_j d_j . (p_j - x) / |p_j - x|^3, with the squares expanded so that both factors are matrix products.
    ones = np.ones(len(x))
    to_squares = _tensor(np.vstack([-2 * sources.T, np.ones(len(sources)), np.square(sources).sum(axis=1)]), dtype)
    to_flux = _tensor(np.vstack([-dipoles.T, np.einsum("jc,jc->j", dipoles, sources)]), dtype)
    queries = _tensor(np.column_stack([x, np.square(x).sum(axis=1), ones]), dtype)
    least = _tensor(np.square(radii), dtype)
    found = np.empty(len(x))

    def fill(rows: slice) -> None:
        some = queries[rows]
        square = some @ to_squares
        near = torch.maximum(square, least, out=square).rsqrt_()
        flux = (some[:, [0, 1, 2, 4]] @ to_flux).mul_(near).mul_(near).mul_(near)
        found[rows] = flux.sum(dim=1).numpy()

    map_in_threads(fill, slices(len(x), max(least_batch, batch_terms // max(len(sources), 1))))
    return found


def _tensor(values: Float, dtype: torch.dtype) -> torch.Tensor:
    return torch.as_tensor(values, dtype=dtype)
