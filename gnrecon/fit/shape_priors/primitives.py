"""Planes, round cylinders and spheres, the surfaces of most made things, found among oriented points.

What proposes a plane is a single point whose neighbours lie on it; what proposes a cylinder is two points, whose
normals cross its axis at right angles, and a sphere two whose normals meet in its centre. Of the proposals that which
most points agree with is fitted to them, they are taken out, and the search goes on.
Source: Schnabel, Wahl and Klein, Efficient RANSAC for Point-Cloud Shape Detection (2007).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from scipy.optimize import least_squares

from gnrecon.geometry.arrays import Float, Int, Mask
from gnrecon.geometry.signed_distance import Density

ANGLE = 10.0
"""Degrees between a point's normal and the surface's that it lies on, at most."""

LEAST, MOST = 12, 12
"""Least points of a surface, and most surfaces of a round of proposals."""

MISSED = 30
"""Proposals in a row that may fail, the largest first, before no more are tried: on made shapes one in that many holds,
and on round ones, of which each piece looks like some surface, hundreds would be fitted in vain."""

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

ASTRAY = 0.2
"""How far the normals of two points on a sphere pass each other at most, in its radii."""

BENT = 25.0
"""Degrees by which the farthest normal of a round surface differs from their mean at least."""

NEARLY, ASIDE, TOUCHES = 30.0, 5.0, (1.0, 1.2)
"""Degrees between a surface's normal and those of points beside it that nearly belong to it, how near these are, in
radii of a disk, and their most share for planes and for round ones, whose rims are often bevelled."""

SETTLED = 0.5
"""Share of a proposal's points that belong to a surface that is settled, from which on it is none."""

NORMAL_WEIGHT = 0.3
"""What a normal's difference counts in the fit of a cylinder or a sphere, as a height in radii of a disk."""


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

    def fitted(self, points: Float, normals: Float, _radius: float, _weight: float = NORMAL_WEIGHT) -> Plane:
        """Return the plane nearest to points in the mean square."""
        center = points.mean(axis=0)
        direction = _axes(points - center)[0]
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

    def fitted(self, points: Float, normals: Float, radius: float, weight: float = NORMAL_WEIGHT) -> Cylinder:
        """Return the cylinder nearest to points and, by a weight, their normals; `radius` is that of a point's disk."""
        axis, upward, aside = _axes(normals)

        def moved(by: Float) -> Cylinder:
            turned = axis + by[0] * aside + by[1] * upward
            center = self.center + by[2] * aside + by[3] * upward
            return Cylinder(center, turned / np.linalg.norm(turned), by[4], self.side)

        def residuals(by: Float) -> Float:
            trial = moved(by)
            turn = weight * (trial.normal(points) - normals)
            return np.concatenate([trial.at(points) / radius, turn.ravel()])

        return moved(least_squares(residuals, [0.0, 0.0, 0.0, 0.0, self.radius], method="lm", max_nfev=FITTED).x)

    def _across(self, x: Float) -> Float:
        beyond = x - self.center
        across: Float = beyond - (beyond @ self.axis)[:, None] * self.axis
        return across


@dataclass(frozen=True)
class Sphere:
    """A sphere.

    Parameters
    ----------
    center : array of shape (3,)
    radius : unit coordinates
    side : 1 for a ball, -1 for a hollow
    """

    center: Float
    radius: float
    side: float

    def at(self, x: Float) -> Float:
        """Return the distance from the centre less the radius, or the reverse in a hollow."""
        distance: Float = self.side * (np.linalg.norm(x - self.center, axis=1) - self.radius)
        return distance

    def normal(self, x: Float) -> Float:
        """Return the direction away from the centre, or towards it in a hollow."""
        beyond = x - self.center
        outward: Float = self.side * beyond / np.maximum(np.linalg.norm(beyond, axis=1, keepdims=True), 1e-12)
        return outward

    def fitted(self, points: Float, normals: Float, radius: float, weight: float = NORMAL_WEIGHT) -> Sphere:
        """Return the sphere nearest to points and, by a weight, their normals; `radius` is that of a point's disk."""

        def residuals(by: Float) -> Float:
            trial = Sphere(self.center + by[:3], by[3], self.side)
            turn = weight * (trial.normal(points) - normals)
            return np.concatenate([trial.at(points) / radius, turn.ravel()])

        found = least_squares(residuals, [0.0, 0.0, 0.0, self.radius], method="lm", max_nfev=FITTED).x
        return Sphere(self.center + found[:3], float(found[3]), self.side)


Primitive = Plane | Cylinder | Sphere
KINDS = (Plane, Cylinder, Sphere)


@dataclass(frozen=True)
class Seen:
    """A surface, and the points of shape (K, 3) that lie on it."""

    surface: Primitive
    points: Float


@dataclass(frozen=True)
class Wanted:
    """Which surfaces are looked for.

    Parameters
    ----------
    angle : degrees between a point's normal and that of its surface, at most
    spheres : whether spheres are, too
    touches : most share of points beside a surface that nearly belong to it, of planes and of round ones
    sparse : whether planes may have fewer points than the rest, as faces that were seen from the side
    """

    angle: float = ANGLE
    spheres: bool = False
    touches: tuple[float, float] = TOUCHES
    sparse: bool = False


def surfaces(
    points: Float,
    normals: Float,
    asked: Mask,
    radius: float,
    off: float,
    rng: np.random.Generator,
    wanted: Wanted | None = None,
) -> list[Seen]:
    """Return planes and cylinders of oriented points, or what else is wanted.

    Parameters
    ----------
    points, normals : arrays of shape (N, 3), unit normals
    asked : mask of shape (N,), of the points that propose surfaces
    radius : of the disk that a point stands for
    off : how far off a surface its points lie at most
    rng : draws those that do
    wanted : which surfaces
    """
    if len(points) <= BESIDE:
        return []
    return _Search(points, normals, radius, off, rng, wanted or Wanted()).surfaces(asked)


def planar_share(points: Float, normals: Float, radius: float, off: float, rng: np.random.Generator) -> float:
    """Return the share of oriented points that lie on planes; the parameters are those of `surfaces`."""
    search, everything = _Search(points, normals, radius, off, rng), np.arange(len(points))
    found, _ = search.taken(everything, search.planes(everything))
    return sum(len(one.points) for one in found) / max(len(points), 1)


def feet(surface: Surface, points: Float) -> Float:
    """Return the points of a surface nearest to some, all of shape (K, 3)."""
    nearest: Float = points - surface.at(points)[:, None] * surface.normal(points)
    return nearest


def agreed(surface: Surface, points: Float, normals: Float, off: float, angle: float = ANGLE) -> Mask:
    """Return which points, of shape (N, 3), lie on a surface: no farther off it, and by their normals, in degrees."""
    on = np.abs(surface.at(points)) < off
    turned: Float = np.einsum("kd,kd->k", surface.normal(points), normals)
    agreeing: Mask = on & (turned > cosine_of(angle))
    return agreeing


@dataclass(frozen=True)
class _Search:
    """Where surfaces are looked for; everything as in `surfaces`."""

    points: Float
    normals: Float
    radius: float
    off: float
    rng: np.random.Generator
    wanted: Wanted = Wanted()

    def surfaces(self, asked: Mask) -> list[Seen]:
        """Return the surfaces that points, by a mask of shape (N,), propose; each point belongs to one."""
        found: list[Seen] = []
        left: Int = np.arange(len(self.points))
        for _ in range(ROUNDS):
            if len(left) >= LEAST:
                taken, left = self.taken(left, self.planes(left[asked[left]]) + self._round(left, asked[left]))
                found += taken
        return found

    def planes(self, rows: Int) -> list[Primitive]:
        """Return the planes of some points whose neighbours lie on them."""
        beside = list(range(2, BESIDE + 2))
        away, near = self._density.tree.query(self.points[rows], beside)
        own = self._density.disks[rows, None] if self.wanted.sparse else 0.0
        absent = away > NEAR * np.maximum(own, self.radius)
        height = np.einsum("ikd,id->ik", self.points[near] - self.points[rows, None], self.normals[rows])
        alike = np.einsum("ikd,id->ik", self.normals[near], self.normals[rows]) > cosine_of(self.wanted.angle)
        flat = rows[((np.abs(height) < self.off) & alike & ~absent).mean(axis=1) >= FLAT]
        some = self.rng.choice(flat, min(PROPOSALS, len(flat)), replace=False)
        return [Plane(self.points[row], self.normals[row]) for row in some]

    def _round(self, rows: Int, asked: Mask) -> list[Primitive]:
        """Return cylinders and spheres of pairs of rows, the first of which is one of a mask of shape (rows,)."""
        if not asked.any():
            return []
        points, normals = self.points[rows], self.normals[rows]
        first = self.rng.choice(np.flatnonzero(asked), PROPOSALS)
        found = Density(points).tree.query_ball_point(points[first], APART * self.radius)
        second = np.array([self.rng.choice(sorted(near)) for near in found])
        n, m, beyond = normals[first], normals[second], points[second] - points[first]
        cosine = np.einsum("kd,kd->k", n, m)
        wanted = (cosine < cosine_of(TURNED[0])) & (cosine > cosine_of(TURNED[1]))
        pairs = points[first[wanted]], n[wanted], m[wanted], beyond[wanted]
        return self._cylinders(*pairs) + (self._spheres(*pairs) if self.wanted.spheres else [])

    def _cylinders(self, points: Float, n: Float, m: Float, beyond: Float) -> list[Primitive]:
        """Return the cylinders of points, of shape (K, 3), with normals n, and of those `beyond` with normals m."""
        axis = np.cross(n, m)
        axis /= np.linalg.norm(axis, axis=1, keepdims=True)
        # Both points lie as far from the axis, along their normals: p + s n = q + s m but for what is along the axis.
        reach = _meeting(n, m, beyond - np.einsum("kd,kd->k", beyond, axis)[:, None] * axis)
        center, size = points + reach[:, None] * n, np.abs(reach)
        proper = np.flatnonzero((size > ROUND * self.radius) & (size < STRAIGHT * self.radius))
        return [Cylinder(center[k], axis[k], float(size[k]), float(-np.sign(reach[k]))) for k in proper]

    def _spheres(self, points: Float, n: Float, m: Float, beyond: Float) -> list[Primitive]:
        """Return the spheres of the same whose normals meet in the centre; points on a cylinder's sides do not."""
        reach = _meeting(n, m, beyond)
        missed = np.linalg.norm(reach[:, None] * (n - m) - beyond, axis=1)
        size = np.abs(reach)
        proper = np.flatnonzero((size > ROUND * self.radius) & (missed < ASTRAY * size))
        return [Sphere(points[k] + reach[k] * n[k], float(size[k]), float(-np.sign(reach[k]))) for k in proper]

    def taken(self, rows: Int, proposed: list[Primitive]) -> tuple[list[Seen], Int]:
        """Return those of the proposed surfaces that hold, the largest first, and which of the rows are left."""
        found: list[Seen] = []
        points, normals = self.points[rows], self.normals[rows]
        agreeing = np.array([agreed(one, points, normals, self.off, self.wanted.angle) for one in proposed])
        agreeing = agreeing.reshape(len(proposed), len(rows))
        kinds = np.array([KINDS.index(type(one)) for one in proposed])
        free, wanted = np.ones(len(rows), dtype=bool), np.ones(len(proposed), dtype=bool)
        missed = 0
        while wanted.any() and len(found) < MOST and missed < MISSED:
            count = np.where(wanted, (agreeing & free).sum(axis=1), 0)
            best = int(np.argmax(count))
            if count[best] < LEAST:
                break
            surface, on = proposed[best], agreeing[best] & free
            for _ in range(FITS):
                before = int(on.sum())
                surface = surface.fitted(points[on], normals[on], self.radius)
                on = agreed(surface, points, normals, self.off, self.wanted.angle) & free
                if int(on.sum()) <= max(before, LEAST):
                    break
            holds = self._ends(surface, points[free], normals[free], on[free])
            # What mostly agrees with what is settled is no proposal any more; what is no cylinder may be a plane.
            like = on if holds else agreeing[best] & free
            settled = (agreeing & like).sum(axis=1) >= SETTLED * count
            wanted &= ~(settled & (holds | (kinds == kinds[best])))
            wanted[best] = False
            missed = 0 if holds else missed + 1
            if holds:
                found.append(Seen(surface, points[on]))
                free &= ~on
        return found, rows[free]

    def _ends(self, surface: Primitive, points: Float, normals: Float, on: Mask) -> bool:
        """Return whether a surface ends where its points do, as faces do at edges; a shape that bends away it touches.

        Parameters
        ----------
        points, normals : arrays of shape (K, 3)
        on : mask of shape (K,), of those that lie on the surface
        """
        if int(on.sum()) < LEAST or (not isinstance(surface, Plane) and _bend(normals[on]) < BENT):
            return False
        near = Density(points[on]).tree.query(points)[0] < ASIDE * self.radius
        nearly = near & (np.einsum("kd,kd->k", surface.normal(points), normals) > cosine_of(NEARLY)) & ~on
        most = self.wanted.touches[not isinstance(surface, Plane)]
        return bool(nearly.sum() < most * on.sum())

    @cached_property
    def _density(self) -> Density:
        return Density(self.points)


def _axes(directions: Float) -> Float:
    """Return unit vectors at right angles, in rows, first that along which directions, of shape (K, 3), are least."""
    axes: Float = np.linalg.eigh(directions.T @ directions)[1].T
    return axes


def _meeting(n: Float, m: Float, beyond: Float) -> Float:
    """Return how far along its normal, of shape (K, 3), each of two points comes nearest to the other; m is its."""
    turn = n - m
    reach: Float = np.einsum("kd,kd->k", beyond, turn) / np.einsum("kd,kd->k", turn, turn)
    return reach


def _bend(normals: Float) -> float:
    """Return the angle of the farthest of some normals from their mean, in degrees."""
    mean = normals.mean(axis=0)
    cosine = normals @ (mean / max(np.linalg.norm(mean), 1e-12))
    return float(np.degrees(np.arccos(cosine.min().clip(-1.0, 1.0))))


def cosine_of(degrees: float) -> float:
    """Return the cosine of an angle in degrees."""
    return float(np.cos(np.radians(degrees)))
