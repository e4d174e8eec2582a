"""Where a field is sampled: in the volume, near the surface; and a coarse signed distance to supervise it there.

The sign is that of the generalised winding number w(x) = sum_j a_j n_j . (p_j - x) / (4 pi |p_j - x|^3) of the cloud,
with a_j the area that point j stands for: above one half means inside. It closes holes and open scans much as a soap
film would, and is right wherever x is farther from the surface than the points are from each other, where the nearest
normals often are not. Source: Barill et al., Fast Winding Numbers for Soups and Clouds (2018).

The size follows from the distance d to the nearest point. A surface seen through points of which each stands for a
disk of radius rho is nearer than they are: for random points the nearest one lies rho beside the foot of x in the root
mean square, so that sqrt(d^2 - rho^2) is used. Samples nearer than 2 rho tell nothing and are left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch

from gnrecon.geometry.arrays import Float, Int, Mask
from gnrecon.runtime.chunks import slices
from gnrecon.runtime.parallel import abreast

_SOURCES = 4000
_NEIGHBOURS = 8

_TOGETHER = 64
"""Points whose winding numbers are summed at once: their terms stay in the processor's cache."""

KNOWN = 2.0
"""How far from the points a distance is known at least, in radii of the disk that the nearest one stands for."""

CERTAIN = 0.25
"""How far from one half a winding number is beyond doubt: across a hole it passes through one half slowly."""

STEEPNESS = 0.3
"""Least magnitude of a field in the free space, as a share of the distance from the surface."""


LEAST_HALF = 4
"""Points that `halved` leaves together: their order within says nothing."""


@dataclass(frozen=True)
class Box:
    """An axis-aligned box, unit coordinates."""

    lower: Float
    upper: Float

    @classmethod
    def around(cls, points: Float, margin: float) -> Box:
        """Return the bounding box of `points`, of shape (N, 3), widened by `margin` on each side."""
        return cls(points.min(axis=0) - margin, points.max(axis=0) + margin)

    def sample(self, count: int, rng: np.random.Generator) -> Float:
        """Return uniform points, of shape (count, 3)."""
        return rng.uniform(self.lower, self.upper, (count, 3))


def halved(points: Float) -> Int:
    """Return an order of points, of shape (N, 3), in which any aligned run of 4, 8, 16 ... of them is a compact patch.

    Groups are cut in half across their longest side until four are left, the first half of each a power of two.
    """
    points = np.asarray(points)
    rows = np.arange(len(points))
    order = rows
    size = 1 << max(len(points) - 1, 0).bit_length()
    while size > LEAST_HALF:
        ordered, group = points[order], rows // size
        lower = np.minimum.reduceat(ordered, rows[::size])
        sides = np.maximum.reduceat(ordered, rows[::size]) - lower
        longest = sides.argmax(axis=1)
        place = (ordered - lower[group])[rows, longest[group]]
        # The groups stay in their order, and points of a group are sorted along its side.
        order = order[np.argsort(group + 0.5 * place / np.maximum(sides.max(axis=1), np.finfo(float).tiny)[group])]
        size //= 2
    return order


def near_surface(points: Float, spread: float, count: int, rng: np.random.Generator) -> Float:
    """Return `count` points, of shape (count, 3): data points moved by normal noise of standard deviation `spread`."""
    return points[rng.integers(len(points), size=count)] + spread * rng.standard_normal((count, 3))


def least_values(signed: Float, most: float) -> Float:
    """Return what a field should be at least where the free space has signed distances, of shape (Q,), on its own side.

    No more than `most` is asked: what is far from the surface does not matter, as long as the sign is right.
    """
    least: Float = np.sign(signed) * np.minimum(STEEPNESS * np.abs(signed), most)
    return least


@dataclass(frozen=True)
class Density:
    """How densely points lie; everything is found when it is first asked for.

    Parameters
    ----------
    points : array of shape (N, 3)
    """

    points: Float

    @cached_property
    def tree(self) -> Any:
        """A `scipy.spatial.cKDTree` of the points."""
        from scipy.spatial import cKDTree

        return cKDTree(self.points)

    @cached_property
    def spacing(self) -> float:
        """Median distance from a point to its nearest neighbour."""
        return float(np.median(self.tree.query(self.points, k=2)[0][:, 1]))

    @cached_property
    def disks(self) -> Float:
        """Radius of the disk that each point stands for, of shape (N,): that of its k-th neighbour's, shared by k."""
        k = min(_NEIGHBOURS, len(self.points) - 1)
        radii: Float = self.tree.query(self.points, k + 1)[0][:, -1] / np.sqrt(k)
        return radii

    @cached_property
    def radius(self) -> float:
        """Median of the disks' radii."""
        return float(np.median(self.disks))


class CoarseDistance:
    """Signed distance to a cloud, coarse, its sign reliable beyond the spacing of the points; negative inside.

    Parameters
    ----------
    points, normals : arrays of shape (N, 3), unit coordinates, outward unit normals
    rng : draws the subset of at most 4,000 points that the winding number sums over
    density : of the points, where it is known already
    """

    def __init__(self, points: Float, normals: Float, rng: np.random.Generator, density: Density | None = None) -> None:
        self._density = density or Density(points)
        self.spacing = self._density.spacing
        chosen = np.sort(rng.permutation(len(points))[:_SOURCES])
        self._sources = points[chosen]
        self._radii = Density(self._sources).disks
        self._dipoles = normals[chosen] * (self._radii**2 / 4)[:, None]

    def sample(self, x: Float) -> tuple[Float, Float]:
        """Return those of the points x, of shape (Q, 3), where the distance is known, and the distances there."""
        known, signed, *_ = self.at(x)
        return x[known], signed

    def at(self, x: Float, clear: float = KNOWN) -> tuple[Mask, Float, Float, Mask]:
        """Return which of the points x, of shape (Q, 3), lie more than `clear` disks' radii from their nearest point.

        Of these, in their order, follow the signed distances, those to the nearest point itself, and where the sign is
        beyond doubt.
        """
        known, size, nearest = self.size(x, clear)
        winding = self.winding_number(x[known])
        return known, side_of(winding) * size, nearest, is_certain(winding)

    def size(self, x: Float, clear: float = KNOWN) -> tuple[Mask, Float, Float]:
        """Return the first three of `at`, but for the sign, which is what takes time."""
        # One worker: with several, Ctrl-C unwinds while scipy's threads still use the arrays, and the process crashes.
        nearest, rows = self._density.tree.query(x)
        disks = self._density.disks[rows]
        known = nearest > clear * disks
        nearest, disks = nearest[known], disks[known]
        return known, np.sqrt(nearest**2 - disks**2), nearest

    def sign(self, x: Float) -> Float:
        """Return the sign of the distance, of shape (Q,), at x, of shape (Q, 3)."""
        return side_of(self.winding_number(x))

    def winding_number(self, x: Float, batch: int = _TOGETHER) -> Float:
        """Return w, of shape (Q,), at points x, of shape (Q, 3); each term is bounded within its own disk."""
        # Of so few sources none has a disk for which single precision would not do.
        return winding_number(x, self._sources, self._dipoles, self._radii, batch, torch.float32)


def side_of(winding: Float) -> Float:
    """Return the sign of the distance, of shape (Q,), that winding numbers tell: negative inside."""
    return np.where(winding > 0.5, -1.0, 1.0)


def is_certain(winding: Float) -> Mask:
    """Return where winding numbers, of shape (Q,), tell the sign beyond doubt."""
    return np.asarray(np.abs(winding - 0.5) > CERTAIN)


def winding_number(
    x: Float, sources: Float, dipoles: Float, radii: Float, batch: int = _TOGETHER, dtype: torch.dtype = torch.float64
) -> Float:
    """Return the winding number w, of shape (Q,), that dipoles make at points x, of shape (Q, 3).

    Parameters
    ----------
    sources : array of shape (J, 3), where the dipoles are
    dipoles : array of shape (J, 3), each a normal times the area that it stands for, over 4 pi
    radii : array of shape (J,), of the disks of those areas, within which a term is bounded
    batch : points that are asked for at once
    dtype : that the terms are computed in; single precision is several times as fast, and does where radii are not
        below 1e-3 of the coordinates
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

    abreast(fill, slices(len(x), batch))
    return found


def _tensor(values: Float, dtype: torch.dtype) -> torch.Tensor:
    return torch.as_tensor(values, dtype=dtype)
