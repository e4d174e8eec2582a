"""Snaps noisy points to the planes, round cylinders and spheres from which they cannot be distinguished.

Averaging reduces a point's noise by some tens of its neighbours. A face of a machine part has hundreds of points, and
where it is a plane, a cylinder or a sphere as far as they show, all of them determine it. This is so where the heights
over it are not larger than the noise, and pass the whiteness test (`whiteness_test`).

Primitives are detected among averaged points, and fitted to the scanned ones. Where faces are as small as the averaged
neighbourhoods, as in bores, averages mix faces; so the points that are left are averaged separately, over less, and
searched once more. Entry: `snap_to_primitives`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gnrecon.fit.shape_priors.bilateral_filter import BilateralFilter
from gnrecon.fit.shape_priors.primitive_detection import DetectedPrimitive, detect_primitives
from gnrecon.fit.shape_priors.primitives import Primitive, cosine_of, is_inlier, project
from gnrecon.fit.shape_priors.prior_parameters import SnappingParameters
from gnrecon.fit.shape_priors.whiteness_test import is_white_noise
from gnrecon.geometry.arrays import Float, Int, Mask
from gnrecon.geometry.signed_distance import Density
from gnrecon.geometry.statistics import robust_deviation


@dataclass(frozen=True)
class SnappedPoints:
    """Points snapped to primitives.

    Parameters
    ----------
    points, normals : arrays of shape (N, 3), unit normals; those on no primitive averaged
    on_primitive : mask of shape (N,)
    primitives : their number
    """

    points: Float
    normals: Float
    on_primitive: Mask
    primitives: int


def snap_to_primitives(
    points: Float,
    normals: Float,
    averaged: tuple[Float, Float],
    parameters: SnappingParameters = SnappingParameters(),
) -> SnappedPoints | None:
    """Return the points of a machine part on its planes, cylinders and spheres, or None of any other shape.

    Parameters
    ----------
    points, normals : arrays of shape (N, 3), unit coordinates, outward unit normals, as they were scanned
    averaged : the same points and normals with less noise
    parameters : of the snapping
    """
    p = parameters
    if len(points) <= p.detection.min_points:
        return None
    density = Density(points)
    off = np.einsum("nd,nd->n", points - averaged[0], averaged[1])
    # A robust deviation: neither edges nor outliers change it much.
    noise = max(robust_deviation(off), p.exact_radii * density.radius)
    search = FaceSearch(density, noise, np.random.default_rng(0), p)
    found = search.detect(*averaged, p.first_degrees, [])
    if search.share(found) < p.min_snapped_share:
        return None
    rest = search.left(found)
    if len(rest) > p.detection.min_points:
        narrow = np.array(points), np.array(normals)
        averaging = BilateralFilter(p.narrow_width_radii, p.narrow_normal_scale)
        narrow[0][rest], narrow[1][rest] = averaging.apply(points[rest], normals[rest])
        found = search.detect(*narrow, p.narrow_degrees, found)
    return search.snap(found, *averaged)


@dataclass(frozen=True)
class PrimitiveFace:
    """A primitive and the rows of the points on it."""

    surface: Primitive
    rows: Int


@dataclass(frozen=True)
class FaceSearch:
    """Scanned points, their density, and the noise of their positions, among which faces are looked for."""

    density: Density
    noise: float
    rng: np.random.Generator
    parameters: SnappingParameters = SnappingParameters()

    @property
    def points(self) -> Float:
        """The points, of shape (N, 3)."""
        return self.density.points

    @property
    def radius(self) -> float:
        """Radius of their disks."""
        return self.density.radius

    @property
    def max_height(self) -> float:
        """Largest height of a point over its primitive."""
        return self.parameters.max_height_deviations * self.noise

    def left(self, found: list[PrimitiveFace]) -> Int:
        """Return the rows of the points that are on none of some faces."""
        free = np.ones(len(self.points), dtype=bool)
        for face in found:
            free[face.rows] = False
        return np.flatnonzero(free)

    def share(self, found: list[PrimitiveFace]) -> float:
        """Return the share of the points that are on some faces."""
        return 1.0 - len(self.left(found)) / len(self.points)

    def detect(
        self, points: Float, normals: Float, angle_degrees: float, found: list[PrimitiveFace]
    ) -> list[PrimitiveFace]:
        """Return some faces, and those detected among the points that are on none of them.

        Parameters
        ----------
        points, normals : arrays of shape (N, 3), averaged, which propose primitives
        angle_degrees : between a point's normal and its primitive's, at most
        found : the faces that are known already
        """
        p = self.parameters
        for _ in range(p.rounds):
            rest = self.left(found)
            some = np.sort(self.rng.permutation(rest)[: p.search_points])
            radius = self.radius * float(np.sqrt(len(rest) / max(len(some), 1)))
            height = max(self.noise, p.min_height_radii * self.radius)
            detection = replace(p.detection, angle_degrees=angle_degrees)
            everything = np.ones(len(some), dtype=bool)
            detected = detect_primitives(points[some], normals[some], everything, radius, height, self.rng, detection)
            before = len(found)
            for one in sorted(detected, key=lambda primitive: -len(primitive.points)):
                face = self._face(one, self.left(found), normals, angle_degrees, p.reach_radii * radius)
                found = found if face is None else [*found, face]
            if len(found) == before:
                break
        return found

    def _face(
        self, detected: DetectedPrimitive, free: Int, normals: Float, angle_degrees: float, reach: float
    ) -> PrimitiveFace | None:
        """Return the face of a primitive fitted to scanned points, or None if these show that it is another shape.

        Parameters
        ----------
        detected : the primitive, by averaged points
        free : rows of points that are on no other face
        normals : array of shape (N, 3), averaged unit normals
        angle_degrees : between these and the primitive's, at most
        reach : from a point to those that detected the primitive, at most
        """
        p, least = self.parameters, self.parameters.detection.min_points
        away = Density(detected.points).tree.query(self.points[free])[0]
        rows, around = free[away < reach], free[away < p.rim_reach * reach]
        points, near_normals, surface = self.points[rows], normals[rows], detected.surface
        on = is_inlier(surface, points, near_normals, self.max_height, angle_degrees)
        for weight in p.normal_weights:
            if int(on.sum()) < least:
                return None
            surface = surface.refitted(points[on], near_normals[on], self.radius, weight)
            on = is_inlier(surface, points, near_normals, self.max_height, angle_degrees)
        if int(on.sum()) < least or not self._is_noise(surface, points[on]):
            return None
        points, near_normals = self.points[around], normals[around]
        rim = is_inlier(surface, points, near_normals, p.rim_deviations * self.noise, p.rim_degrees)
        rim &= np.abs(surface.signed_distance(points)) > self.max_height
        if int(rim.sum()) > p.max_rim_share * int(on.sum()):
            return None
        return PrimitiveFace(surface, rows[on])

    def _is_noise(self, surface: Primitive, points: Float, *, max_noise_ratio: float = 1.25) -> bool:
        """Return whether heights over a primitive, at points of shape (K, 3), are noise only.

        `max_noise_ratio` is their largest deviation, over the noise of all points.
        """
        height = surface.signed_distance(points)
        size = float(np.sqrt(np.mean(height**2)))
        if size < self.parameters.exact_radii * self.radius:
            return True
        return size < max_noise_ratio * self.noise and is_white_noise(height, points, project(surface, points))

    def snap(self, found: list[PrimitiveFace], points: Float, normals: Float) -> SnappedPoints:
        """Return the points on their faces, and the others averaged, except those that this moves farther than noise.

        Parameters
        ----------
        found : the faces
        points, normals : arrays of shape (N, 3), averaged
        """
        far = np.linalg.norm(points - self.points, axis=1) > self.max_height
        points, normals = np.where(far[:, None], self.points, points), normals.copy()
        on_primitive = np.zeros(len(points), bool)
        faces = self._with_strays(found, normals)
        for face in faces:
            scanned = self.points[face.rows]
            normals[face.rows] = face.surface.normal(scanned)
            points[face.rows] = project(face.surface, scanned)
            on_primitive[face.rows] = True
        return SnappedPoints(self._clamped_to_edges(faces, points), normals, on_primitive, len(found))

    def _clamped_to_edges(
        self,
        faces: list[PrimitiveFace],
        points: Float,
        *,
        neighbours: int = 12,
        max_wrong_side_share: float = 0.15,
    ) -> Float:
        """Return snapped points, of shape (N, 3), those beyond an edge moved back to it along their face.

        Noise along a face moves some of its points beyond its edge. Where nearly all of them near another face are on
        one side of that, the faces meet in an edge, and the others are beyond it.

        Parameters
        ----------
        faces : the faces
        points : array of shape (N, 3)
        neighbours : of a point, some of which are on another face where there is an edge
        max_wrong_side_share : of a face's points near another that are on the wrong side of it
        """
        p, owner = self.parameters, np.full(len(points), -1)
        for number, face in enumerate(faces):
            owner[face.rows] = number
        rows = np.flatnonzero(owner >= 0)
        away, near = Density(points[rows]).tree.query(points[rows], list(range(2, min(neighbours, len(rows)) + 1)))
        others = owner[rows][near]
        row, rank = np.nonzero((others != owner[rows, None]) & (away < p.reach_radii * self.radius))
        pairs = np.unique(np.stack([owner[rows][row], others[row, rank], rows[row]]), axis=1)
        moved = points.copy()
        for one, other in np.unique(pairs[:2], axis=1).T:
            some = pairs[2][(pairs[0] == one) & (pairs[1] == other)]
            own, opposite = faces[one].surface, faces[other].surface
            x = moved[some]
            height, cosine = opposite.signed_distance(x), np.einsum("kd,kd->k", own.normal(x), opposite.normal(x))
            side = np.sign(np.median(height))
            beyond = (side * height < 0) & (np.abs(cosine) < cosine_of(p.rim_degrees))
            if len(some) < p.detection.min_points or beyond.mean() > max_wrong_side_share:
                continue
            # Points that are farther beyond than noise moves them show that the face continues there.
            beyond &= np.abs(height) < self.max_height
            x, height, cosine = x[beyond], height[beyond], cosine[beyond]
            along = opposite.normal(x) - cosine[:, None] * own.normal(x)
            moved[some[beyond]] = project(own, x - (height / (1 - cosine**2))[:, None] * along)
        return moved

    def _with_strays(
        self, found: list[PrimitiveFace], normals: Float, *, neighbours: int = 6, min_neighbour_share: float = 0.6
    ) -> list[PrimitiveFace]:
        """Return faces with the single points that are farther off, each added to the face most like its normal.

        Near edges there are most of them. Left as they were scanned, they would make spikes.

        Parameters
        ----------
        found : the faces
        normals : array of shape (N, 3), of the points
        neighbours : of a point that decide whether it is a single one
        min_neighbour_share : of these, on faces
        """
        p, left = self.parameters, self.left(found)
        _, near = self.density.tree.query(self.points[left], list(range(2, neighbours + 2)))
        single = np.isin(near, left, invert=True).mean(axis=1) > min_neighbour_share
        rows = left[single]
        points, own = self.points[rows], normals[rows]
        best, most = np.full(len(rows), -1), np.full(len(rows), cosine_of(p.rim_degrees))
        for number, face in enumerate(found):
            cosine = np.einsum("kd,kd->k", face.surface.normal(points), own)
            close = Density(self.points[face.rows]).tree.query(points)[0] < p.reach_radii * self.radius
            height = np.abs(face.surface.signed_distance(points))
            better = close & (height < p.rim_deviations * self.noise) & (cosine > most)
            best[better], most[better] = number, cosine[better]
        return [
            PrimitiveFace(face.surface, np.append(face.rows, rows[best == number])) for number, face in enumerate(found)
        ]
