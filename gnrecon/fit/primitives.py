"""Planes and round cylinders, the surfaces of most made things, found among oriented points.

What proposes a plane is a single point whose neighbours lie on it; what proposes a cylinder is two points, whose
normals cross its axis at right angles. Of the proposals that which most points agree with is fitted to them, they are
taken out, and the search goes on.
Source: Schnabel, Wahl and Klein, Efficient RANSAC for Point-Cloud Shape Detection (2007).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares

from gnrecon.cloud import Float
from gnrecon.sampling import Density

Int = npt.NDArray[np.integer]
Mask = npt.NDArray[np.bool_]

ANGLE = 10.0
"""Degrees between a point's normal and the surface's that it lies on, at most."""

LEAST, MOST = 12, 12
"""Least points of a surface, and most surfaces of a round of proposals."""

FLAT, BESIDE, NEAR = 0.3, 12, 3.0
"""Share of a point's neighbours that lie on its plane where there is one; how many are asked, and how near they are,
in radii of a disk."""

FITS, FITTED = 6, 60
"""How often a surface is fitted at most, while more points agree with it, and most evaluations of a cylinder's fit."""

ROUNDS, PROPOSALS, APART = 3, 200, 16.0
"""How often surfaces are proposed by what is left then, the most proposals of a kind, and how far two points are that
propose one, in radii of a disk."""

TURNED = 12.0, 120.0
"""Degrees between the normals of such points."""

ROUND, STRAIGHT = 1.5, 30.0
"""Least and most radius of a cylinder, in radii of a disk: below, no point tells, and above, it is nearly a plane."""

BENT = 25.0
"""Degrees by which the farthest normal of a cylinder differs from their mean at least."""

NEARLY, ASIDE, TOUCHES = 30.0, 5.0, (1.0, 1.2)
"""Degrees between a surface's normal and those of points beside it that nearly belong to it, how near these are, in
radii of a disk, and their most share for planes and for cylinders, whose rims are often bevelled."""

SETTLED = 0.5
"""Share of a proposal's points that belong to a surface that is settled, from which on it is none."""

NORMAL_WEIGHT = 0.3
"""What a normal's difference counts in a cylinder's fit, as a height in radii of a disk."""


class Surface(Protocol):
    """A surface with an inside."""

    def at(self, x: Float) -> Float:
        """Return the signed distance, of shape (Q,), at x, of shape (Q, 3); negative inside."""

    def normal(self, x: Float) -> Float:
        """Return the outward unit normals, of shape (Q, 3), beside x."""


@dataclass(frozen=True)
class Plane:
    """A plane through a point, of shape (3,), with an outward unit normal, of shape (3,)."""

    center: Float
    direction: Float

    def at(self, x: Float) -> Float:
        """Return the height over the plane."""
        height: Float = (x - self.center) @ self.direction
        return height

    def normal(self, x: Float) -> Float:
        """Return the plane's normal for each x."""
        return np.broadcast_to(self.direction, x.shape)

    def fitted(self, points: Float, normals: Float, _radius: float) -> Plane:
        """Return the plane nearest to points in the mean square."""
        center = points.mean(axis=0)
        direction = np.linalg.svd(points - center, full_matrices=False)[2][2]
        return Plane(center, direction * np.sign(direction @ normals.sum(axis=0)))


@dataclass(frozen=True)
class Cylinder:
    """A round cylinder without ends.

    Parameters
    ----------
    center : array of shape (3,), on the axis
    axis : array of shape (3,), of length one
    radius : unit coordinates
    side : 1 for a peg, -1 for a bore
    """

    center: Float
    axis: Float
    radius: float
    side: float

    def at(self, x: Float) -> Float:
        """Return the distance from the axis less the radius, or the reverse in a bore."""
        distance: Float = self.side * (np.linalg.norm(self._across(x), axis=1) - self.radius)
        return distance

    def normal(self, x: Float) -> Float:
        """Return the direction away from the axis, or towards it in a bore."""
        across = self._across(x)
        outward: Float = self.side * across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
        return outward

    def fitted(self, points: Float, normals: Float, radius: float) -> Cylinder:
        """Return the cylinder nearest to points and their normals; `radius` is that of a point's disk."""
        aside, upward, axis = np.linalg.svd(normals)[2]

        def moved(by: Float) -> Cylinder:
            turned = axis + by[0] * aside + by[1] * upward
            center = self.center + by[2] * aside + by[3] * upward
            return Cylinder(center, turned / np.linalg.norm(turned), by[4], self.side)

        def residuals(by: Float) -> Float:
            trial = moved(by)
            turn = NORMAL_WEIGHT * (trial.normal(points) - normals)
            return np.concatenate([trial.at(points) / radius, turn.ravel()])

        return moved(least_squares(residuals, [0.0, 0.0, 0.0, 0.0, self.radius], method="lm", max_nfev=FITTED).x)

    def _across(self, x: Float) -> Float:
        beyond = x - self.center
        across: Float = beyond - (beyond @ self.axis)[:, None] * self.axis
        return across


@dataclass(frozen=True)
class Seen:
    """A surface, and the points of shape (K, 3) that lie on it."""

    surface: Plane | Cylinder
    points: Float


def surfaces(
    points: Float, normals: Float, asked: Mask, radius: float, off: float, rng: np.random.Generator
) -> list[Seen]:
    """Return planes and cylinders of oriented points.

    Parameters
    ----------
    points, normals : arrays of shape (N, 3), unit normals
    asked : mask of shape (N,), of the points that propose surfaces
    radius : of the disk that a point stands for
    off : how far off a surface its points lie at most
    rng : draws those that do
    """
    if len(points) <= BESIDE:
        return []
    return _Search(points, normals, radius, off, rng).surfaces(asked)


def planar_share(points: Float, normals: Float, radius: float, off: float, rng: np.random.Generator) -> float:
    """Return the share of oriented points that lie on planes; the parameters are those of `surfaces`."""
    search, everything = _Search(points, normals, radius, off, rng), np.arange(len(points))
    found, _ = search.taken(everything, search.planes(everything))
    return sum(len(one.points) for one in found) / max(len(points), 1)


def agreed(surface: Surface, points: Float, normals: Float, off: float) -> Mask:
    """Return which points, of shape (N, 3), lie on a surface: no farther off it, and by their normals."""
    on = np.abs(surface.at(points)) < off
    turned: Float = np.einsum("kd,kd->k", surface.normal(points), normals)
    agreeing: Mask = on & (turned > cosine_of(ANGLE))
    return agreeing


@dataclass(frozen=True)
class _Search:
    """Where surfaces are looked for; everything as in `surfaces`."""

    points: Float
    normals: Float
    radius: float
    off: float
    rng: np.random.Generator

    def surfaces(self, asked: Mask) -> list[Seen]:
        """Return the surfaces that points, by a mask of shape (N,), propose; each point belongs to one."""
        found: list[Seen] = []
        left: Int = np.arange(len(self.points))
        for _ in range(ROUNDS):
            if len(left) >= LEAST:
                taken, left = self.taken(left, self.planes(left[asked[left]]) + self._cylinders(left, asked[left]))
                found += taken
        return found

    def planes(self, rows: Int) -> list[Plane | Cylinder]:
        """Return the planes of some points whose neighbours lie on them."""
        beside = list(range(2, BESIDE + 2))
        _, near = self._density.tree.query(self.points[rows], beside, distance_upper_bound=NEAR * self.radius)
        absent = near == len(self.points)
        near = np.where(absent, 0, near)
        height = np.einsum("ikd,id->ik", self.points[near] - self.points[rows, None], self.normals[rows])
        alike = np.einsum("ikd,id->ik", self.normals[near], self.normals[rows]) > cosine_of(ANGLE)
        flat = rows[((np.abs(height) < self.off) & alike & ~absent).mean(axis=1) >= FLAT]
        some = self.rng.choice(flat, min(PROPOSALS, len(flat)), replace=False)
        return [Plane(self.points[row], self.normals[row]) for row in some]

    def _cylinders(self, rows: Int, asked: Mask) -> list[Plane | Cylinder]:
        """Return the cylinders of pairs of rows, the first of which is one of those by a mask of shape (rows,)."""
        if not asked.any():
            return []
        points, normals = self.points[rows], self.normals[rows]
        first = self.rng.choice(np.flatnonzero(asked), PROPOSALS)
        found = Density(points).tree.query_ball_point(points[first], APART * self.radius)
        second = np.array([self.rng.choice(sorted(near)) for near in found])
        n, m, beyond = normals[first], normals[second], points[second] - points[first]
        cosine = np.einsum("kd,kd->k", n, m)
        wanted = (cosine < cosine_of(TURNED[0])) & (cosine > cosine_of(TURNED[1]))
        first, n, m, beyond = first[wanted], n[wanted], m[wanted], beyond[wanted]
        axis = np.cross(n, m)
        axis /= np.linalg.norm(axis, axis=1, keepdims=True)
        # Both points lie as far from the axis, along their normals: p + s n = q + s m but for what is along the axis.
        beyond -= np.einsum("kd,kd->k", beyond, axis)[:, None] * axis
        turn = n - m
        reach = np.einsum("kd,kd->k", beyond, turn) / np.einsum("kd,kd->k", turn, turn)
        center = points[first] + reach[:, None] * n
        size = np.abs(reach)
        proper = np.flatnonzero((size > ROUND * self.radius) & (size < STRAIGHT * self.radius))
        return [Cylinder(center[k], axis[k], float(size[k]), float(-np.sign(reach[k]))) for k in proper]

    def taken(self, rows: Int, proposed: list[Plane | Cylinder]) -> tuple[list[Seen], Int]:
        """Return those of the proposed surfaces that hold, the largest first, and which of the rows are left."""
        found: list[Seen] = []
        points, normals = self.points[rows], self.normals[rows]
        agreeing = np.array([agreed(one, points, normals, self.off) for one in proposed])
        agreeing = agreeing.reshape(len(proposed), len(rows))
        cylinders = np.array([isinstance(one, Cylinder) for one in proposed], dtype=bool)
        free, wanted = np.ones(len(rows), dtype=bool), np.ones(len(proposed), dtype=bool)
        while wanted.any() and len(found) < MOST:
            count = np.where(wanted, (agreeing & free).sum(axis=1), 0)
            best = int(np.argmax(count))
            if count[best] < LEAST:
                break
            surface, on = proposed[best], agreeing[best] & free
            for _ in range(FITS):
                before = int(on.sum())
                surface = surface.fitted(points[on], normals[on], self.radius)
                on = agreed(surface, points, normals, self.off) & free
                if int(on.sum()) <= max(before, LEAST):
                    break
            holds = self._ends(surface, points[free], normals[free], on[free])
            # What mostly agrees with what is settled is no proposal any more; what no cylinder fits may be a plane.
            like = on if holds else agreeing[best] & free
            settled = (agreeing & like).sum(axis=1) >= SETTLED * count
            wanted &= ~(settled & (holds | (cylinders == cylinders[best])))
            wanted[best] = False
            if holds:
                found.append(Seen(surface, points[on]))
                free &= ~on
        return found, rows[free]

    def _ends(self, surface: Plane | Cylinder, points: Float, normals: Float, on: Mask) -> bool:
        """Return whether a surface ends where its points do, as faces do at edges; a shape that bends away it touches.

        Parameters
        ----------
        points, normals : arrays of shape (K, 3)
        on : mask of shape (K,), of those that lie on the surface
        """
        if int(on.sum()) < LEAST or (isinstance(surface, Cylinder) and _bend(normals[on]) < BENT):
            return False
        near = Density(points[on]).tree.query(points)[0] < ASIDE * self.radius
        nearly = near & (np.einsum("kd,kd->k", surface.normal(points), normals) > cosine_of(NEARLY)) & ~on
        most = TOUCHES[isinstance(surface, Cylinder)]
        return bool(nearly.sum() < most * on.sum())

    @cached_property
    def _density(self) -> Density:
        return Density(self.points)


def _bend(normals: Float) -> float:
    """Return the angle of the farthest of some normals from their mean, in degrees."""
    mean = normals.mean(axis=0)
    cosine = normals @ (mean / max(np.linalg.norm(mean), 1e-12))
    return float(np.degrees(np.arccos(cosine.min().clip(-1.0, 1.0))))


def cosine_of(degrees: float) -> float:
    """Return the cosine of an angle in degrees."""
    return float(np.cos(np.radians(degrees)))
