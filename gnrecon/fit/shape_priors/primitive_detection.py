"""Detects planes, round cylinders and spheres, the surfaces of most machine parts, among oriented points.

A plane is proposed by one point whose neighbours lie on it, a cylinder by two points whose normals are perpendicular to
its axis, and a sphere by two whose normals meet in its centre. The proposal with the most inliers is fitted to them,
they are removed, and the search continues.
Source: Schnabel, Wahl and Klein, Efficient RANSAC for Point-Cloud Shape Detection (2007).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from gnrecon.fit.shape_priors.primitives import Cylinder, Plane, Primitive, Sphere, cosine_of, is_inlier
from gnrecon.fit.shape_priors.prior_parameters import DetectionParameters
from gnrecon.geometry.arrays import Float, Int, Mask
from gnrecon.geometry.signed_distance import Density
from gnrecon.geometry.statistics import widest_gap


@dataclass(frozen=True)
class DetectedPrimitive:
    """A primitive, and its inliers, of shape (K, 3)."""

    surface: Primitive
    points: Float


def detect_primitives(
    points: Float,
    normals: Float,
    proposing: Mask,
    radius: float,
    max_height: float,
    rng: np.random.Generator,
    parameters: DetectionParameters = DetectionParameters(),
) -> list[DetectedPrimitive]:
    """Return the primitives of oriented points; each point belongs to one of them at most.

    Parameters
    ----------
    points, normals : arrays of shape (N, 3), unit normals
    proposing : mask of shape (N,), of the points that may propose primitives
    radius : of the disk that a point stands for
    max_height : of an inlier over its primitive
    rng : draws the proposals
    parameters : of the detection
    """
    if len(points) <= parameters.flat_neighbours:
        return []
    return _Detector(points, normals, radius, max_height, rng, parameters).detect(proposing)


def detect_cylinders(
    points: Float,
    normals: Float,
    pairs: Int,
    radius: float,
    max_height: float,
    rng: np.random.Generator,
    parameters: DetectionParameters = DetectionParameters(),
    *,
    max_open_degrees: float,
) -> list[DetectedPrimitive]:
    """Return the round cylinders that pairs of points propose, with points all around them.

    Parameters
    ----------
    pairs : array of shape (K, 2), rows of the points
    max_open_degrees : widest angle around the axis without a point
    points, normals, radius, max_height, rng, parameters : as in `detect_primitives`
    """
    detector = _Detector(points, normals, radius, max_height, rng, parameters)
    found: list[DetectedPrimitive] = []
    left: Int = np.arange(len(points))
    for _ in range(parameters.rounds):
        pairs = pairs[np.isin(pairs, left).all(axis=1)]
        some = pairs if len(pairs) <= parameters.proposals else rng.choice(pairs, parameters.proposals, replace=False)
        accepted, left = detector.accepted(left, detector.cylinders(some), max_open_degrees)
        found += accepted
    return found


def planar_share(
    points: Float,
    normals: Float,
    radius: float,
    max_height: float,
    rng: np.random.Generator,
    parameters: DetectionParameters = DetectionParameters(),
) -> float:
    """Return the share of oriented points that lie on planes; the parameters are those of `detect_primitives`."""
    detector, rows = _Detector(points, normals, radius, max_height, rng, parameters), np.arange(len(points))
    found, _ = detector.accepted(rows, detector.planes(rows))
    return sum(len(one.points) for one in found) / max(len(points), 1)


@dataclass(frozen=True)
class _Detector:
    """The points among which primitives are looked for; everything as in `detect_primitives`."""

    points: Float
    normals: Float
    radius: float
    max_height: float
    rng: np.random.Generator
    parameters: DetectionParameters

    def detect(self, proposing: Mask) -> list[DetectedPrimitive]:
        """Return the primitives that points, by a mask of shape (N,), propose."""
        found: list[DetectedPrimitive] = []
        left: Int = np.arange(len(self.points))
        for _ in range(self.parameters.rounds):
            if len(left) >= self.parameters.min_points:
                proposed = self.planes(left[proposing[left]]) + self._from_pairs(left, proposing[left])
                accepted, left = self.accepted(left, proposed)
                found += accepted
        return found

    def planes(self, rows: Int) -> list[Primitive]:
        """Return the planes through some points whose neighbours lie on them."""
        p = self.parameters
        distance, near = self._density.tree.query(self.points[rows], list(range(2, p.flat_neighbours + 2)))
        own = self._density.disks[rows, None] if p.sparse else 0.0
        absent = distance > p.flat_reach_radii * np.maximum(own, self.radius)
        height = np.einsum("ikd,id->ik", self.points[near] - self.points[rows, None], self.normals[rows])
        alike = np.einsum("ikd,id->ik", self.normals[near], self.normals[rows]) > cosine_of(p.angle_degrees)
        flat = rows[((np.abs(height) < self.max_height) & alike & ~absent).mean(axis=1) >= p.flat_share]
        some = self.rng.choice(flat, min(p.proposals, len(flat)), replace=False)
        return [Plane(self.points[row], self.normals[row]) for row in some]

    def _from_pairs(self, rows: Int, proposing: Mask) -> list[Primitive]:
        """Return cylinders and spheres of pairs of rows, the first of which is one of a mask of shape (rows,)."""
        if not proposing.any():
            return []
        p = self.parameters
        points, normals = self.points[rows], self.normals[rows]
        first = self.rng.choice(np.flatnonzero(proposing), p.proposals)
        found = Density(points).tree.query_ball_point(points[first], p.pair_reach_radii * self.radius)
        second = np.array([self.rng.choice(sorted(near)) for near in found])
        n, m, offset = normals[first], normals[second], points[second] - points[first]
        cosine = np.einsum("kd,kd->k", n, m)
        kept = (cosine < cosine_of(p.min_pair_degrees)) & (cosine > cosine_of(p.max_pair_degrees))
        pairs = points[first[kept]], n[kept], m[kept], offset[kept]
        return [*self._cylinders(*pairs), *(self._spheres(*pairs) if p.spheres else [])]

    def cylinders(self, pairs: Int) -> list[Cylinder]:
        """Return the cylinders of pairs of rows, of shape (K, 2)."""
        one, other = pairs.T
        return self._cylinders(
            self.points[one], self.normals[one], self.normals[other], self.points[other] - self.points[one]
        )

    def _cylinders(self, points: Float, n: Float, m: Float, offset: Float) -> list[Cylinder]:
        """Return the cylinders of points, of shape (K, 3), with normals n, and those at an offset with normals m."""
        axis = np.cross(n, m)
        axis /= np.linalg.norm(axis, axis=1, keepdims=True)
        # Both points are as far from the axis along their normals: p + s n = q + s m, except along the axis.
        reach = _meeting(n, m, offset - np.einsum("kd,kd->k", offset, axis)[:, None] * axis)
        center, size = points + reach[:, None] * n, np.abs(reach)
        least, most = self.parameters.min_round_radii, self.parameters.max_cylinder_radii
        proper = np.flatnonzero((size > least * self.radius) & (size < most * self.radius))
        return [Cylinder(center[k], axis[k], float(size[k]), float(-np.sign(reach[k]))) for k in proper]

    def _spheres(self, points: Float, n: Float, m: Float, offset: Float) -> list[Primitive]:
        """Return the spheres of the same pairs, where the normals meet; those on a cylinder's sides do not."""
        reach = _meeting(n, m, offset)
        missed = np.linalg.norm(reach[:, None] * (n - m) - offset, axis=1)
        size = np.abs(reach)
        p = self.parameters
        proper = np.flatnonzero((size > p.min_round_radii * self.radius) & (missed < p.max_center_miss * size))
        return [Sphere(points[k] + reach[k] * n[k], float(size[k]), float(-np.sign(reach[k]))) for k in proper]

    def accepted(
        self, rows: Int, proposed: Sequence[Primitive], max_open_degrees: float = 360.0
    ) -> tuple[list[DetectedPrimitive], Int]:
        """Return the proposals that pass, those with most inliers first, and which of the rows are left.

        Cylinders with a wider angle around the axis without an inlier are passed over.
        """
        p = self.parameters
        found: list[DetectedPrimitive] = []
        points, normals = self.points[rows], self.normals[rows]
        inliers = np.array([self._inliers(one, points, normals) for one in proposed])
        inliers = inliers.reshape(len(proposed), len(rows))
        kinds = np.array([type(one).__name__ for one in proposed])
        free, open_ = np.ones(len(rows), dtype=bool), np.ones(len(proposed), dtype=bool)
        free_inliers, failures = inliers.sum(axis=1), 0
        while open_.any() and len(found) < p.max_primitives and failures < p.max_failures:
            count = np.where(open_, free_inliers, 0)
            best = int(np.argmax(count))
            if count[best] < p.min_points:
                break
            if max_open_degrees < 360.0 and _open_degrees(proposed[best], points[inliers[best]]) > max_open_degrees:
                open_[best] = False
                continue
            surface, on = self._refitted(proposed[best], points, normals, inliers[best] & free, free)
            passes = self._ends_at_its_rim(surface, points[free], normals[free], on[free])
            # Proposals that share most inliers with this one are settled; what is no cylinder may still be a plane.
            shared = on if passes else inliers[best] & free
            common = inliers[:, shared].sum(axis=1)
            settled = common >= p.redundant_share * count
            open_ &= ~(settled & (passes | (kinds == kinds[best])))
            open_[best] = False
            failures = 0 if passes else failures + 1
            if passes:
                found.append(DetectedPrimitive(surface, points[on]))
                free &= ~on
                free_inliers -= common
        return found, rows[free]

    def _refitted(
        self, surface: Primitive, points: Float, normals: Float, on: Mask, free: Mask
    ) -> tuple[Primitive, Mask]:
        """Return a primitive fitted to its inliers while these become more, and the inliers among the free points."""
        p = self.parameters
        for _ in range(p.max_refits):
            before = int(on.sum())
            surface = surface.refitted(points[on], normals[on], self.radius, p.normal_weight_radii)
            on = self._inliers(surface, points, normals) & free
            if int(on.sum()) <= max(before, p.min_points):
                break
        return surface, on

    def _inliers(self, surface: Primitive, points: Float, normals: Float) -> Mask:
        return is_inlier(surface, points, normals, self.max_height, self.parameters.angle_degrees)

    def _ends_at_its_rim(self, surface: Primitive, points: Float, normals: Float, on: Mask) -> bool:
        """Return whether few points near the rim of a primitive nearly belong to it.

        A face ends at edges. A shape that bends away from the primitive has many such points.

        Parameters
        ----------
        points, normals : arrays of shape (K, 3)
        on : mask of shape (K,), of the inliers
        """
        p, is_round = self.parameters, not isinstance(surface, Plane)
        if int(on.sum()) < p.min_points or (is_round and _bend_degrees(normals[on]) < p.min_bend_degrees):
            return False
        near = Density(points[on]).tree.query(points)[0] < p.rim_reach_radii * self.radius
        cosine = np.einsum("kd,kd->k", surface.normal(points), normals)
        nearly = near & (cosine > cosine_of(p.rim_angle_degrees)) & ~on
        return bool(nearly.sum() < (p.round_rim_share if is_round else p.plane_rim_share) * on.sum())

    @cached_property
    def _density(self) -> Density:
        return Density(self.points)


def _open_degrees(surface: Primitive, points: Float) -> float:
    """Return the widest angle around a cylinder without one of some points; of other primitives, nothing is open."""
    if not isinstance(surface, Cylinder):
        return 0.0
    return float(np.degrees(widest_gap(points - surface.center, surface.axis)))


def meets_on_an_axis(offset: Float, n: Float, m: Float, tolerance: float, *, tilt: float = 0.1) -> Mask:
    """Return which pairs of points, of shape (K,), with normals n and m may lie on a round bore.

    Along both normals an axis is equally far ahead.

    Parameters
    ----------
    offset, n, m : arrays of shape (K, 3), from the first point of a pair to the second, and their normals
    tolerance, tilt : how far apart both may come to the axis: a length, and a share of the distance to it
    """
    axis = np.cross(n, m)
    axis /= np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), 1e-12)
    across = offset - np.einsum("kd,kd->k", offset, axis)[:, None] * axis
    reach = _meeting(n, m, across)
    missed = np.linalg.norm(across - reach[:, None] * (n - m), axis=1)
    meets: Mask = (reach > 0) & (missed < tolerance + tilt * reach)
    return meets


def _meeting(n: Float, m: Float, offset: Float) -> Float:
    """Return how far along its normal n, of shape (K, 3), each point comes nearest to the one at an offset, normal m.

    Both are moved by the same distance along their normals.
    """
    turn = n - m
    reach: Float = np.einsum("kd,kd->k", offset, turn) / np.einsum("kd,kd->k", turn, turn)
    return reach


def _bend_degrees(normals: Float) -> float:
    """Return the angle of the farthest of some normals from their mean."""
    mean = normals.mean(axis=0)
    cosine = normals @ (mean / max(np.linalg.norm(mean), 1e-12))
    return float(np.degrees(np.arccos(cosine.min().clip(-1.0, 1.0))))
