"""Noisy points laid on the planes, round cylinders and spheres that they cannot be told from.

Averaging takes a point's noise by some tens of its neighbours. A face of a made thing has hundreds of points, and where
it is a plane, a cylinder or a sphere for all that they can tell, all of them say where it is. That is so where their
heights over it are no more than the noise, and are noise: neither have neighbours' heights to do with each other, nor
do they follow a quadric, as where the surface is bent otherwise.

Surfaces are looked for among averaged points, and are fitted to the scanned ones. Where faces are as small as the
neighbourhoods, as in bores, averages are taken over other faces; so those that were not found are looked for once more
among what is left, averaged by itself and over less.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from gnrecon.fit.shape_priors.bilateral_filter import Averaging
from gnrecon.fit.shape_priors.primitives import LEAST, Primitive, Seen, Wanted, agreed, cosine_of, feet, surfaces
from gnrecon.fit.shape_priors.whiteness_test import is_white
from gnrecon.geometry.arrays import Float, Int, Mask
from gnrecon.geometry.local_pca import plane_normals, principal_sums
from gnrecon.geometry.signed_distance import Density
from gnrecon.geometry.statistics import robust_deviation

MADE = 0.5
"""Least share of the points that lie on such surfaces, where a shape is a made one: 0.8 and more on machine parts, 0.2
on a gyroid, as a piece of any surface looks like a cylinder to few noisy points."""

NARROW, ANGLES = Averaging(2.0, 0.6), (10.0, 20.0)
"""How what is left is averaged, and degrees between a point's normal and its surface's at most, first and then."""

SOUGHT = 6000
"""Most points among which surfaces are looked for: what so few do not show is found when less is left."""

ROUNDS = 3
"""How often surfaces are looked for at most, with either averaging, while some are found."""

OFF, NEAR, WEIGHTS = 3.0, 3.0, (0.3, 0.0, 0.0)
"""How far a point lies off its surface at most, in deviations of the noise; how far from others of it, in radii of a
disk; and what normals count in each fit: in the last ones nothing, as averages are wrong where a bore is narrow."""

AROUND, CROSSED = 12, 0.15
"""Points beside one, of which some lie on another face where there is an edge; and the most share of a face's points
beside another that are on the wrong side of that."""

SINGLE, BESIDE = 0.6, 6
"""Share of the points beside one that lie on faces, beyond which it is taken for one of theirs; and how many of them
are asked."""

EXACT, SEARCH = 0.02, 0.05
"""Noise below which nothing is asked of the heights, and least height that is granted in the search, in radii of a
disk."""

TOUCHES = 0.5
"""Most share of points beside a face that nearly belong to it. On a bent shape there are more: without this a share of
0.8 of a torus' 3,000 points would be laid on cylinders that a noise of a fourth of their disks cannot rule out."""

RING, ASIDE, NEARLY, BENDS = 3.0, 7.0, 30.0, 0.1
"""How far around a surface its shape may bend away, in what is near; how far off it such points are, in deviations of
the noise, and degrees between their normals and its own, at most; and how many there may be, over its own."""

NO_MORE = 1.25
"""Most deviation of the heights, over the noise."""


@dataclass(frozen=True)
class Laid:
    """Points and unit normals, both of shape (N, 3): those on some surfaces, the others averaged.

    `on` is the mask, of shape (N,), of those that lie on one.
    """

    points: Float
    normals: Float
    on: Mask
    surfaces: int


def laid(points: Float, normals: Float, averaged: tuple[Float, Float]) -> Laid | None:
    """Return the points of a made shape on its planes, cylinders and spheres, or None of any other shape.

    Parameters
    ----------
    points, normals : arrays of shape (N, 3), unit coordinates, outward unit normals, as they were scanned
    averaged : points and normals, the same, with less noise
    """
    if len(points) <= LEAST:
        return None
    density = Density(points)
    off = np.einsum("nd,nd->n", points - averaged[0], averaged[1])
    # The median heeds neither edges nor outliers.
    search = Search(density, max(robust_deviation(off), EXACT * density.radius), np.random.default_rng(0))
    found = search.all(*averaged, ANGLES[0], [])
    if search.share(found) < MADE:
        return None
    rest = search.left(found)
    if len(rest) > LEAST:
        narrow = np.array(points), np.array(normals)
        narrow[0][rest], narrow[1][rest] = NARROW.of(points[rest], normals[rest])
        found = search.all(*narrow, ANGLES[1], found)
    return search.laid(found, *averaged)


@dataclass(frozen=True)
class Face:
    """A surface and the rows of the points that it cannot be told from."""

    surface: Primitive
    rows: Int


@dataclass(frozen=True)
class Search:
    """Scanned points, with how densely they lie, and the noise of their positions."""

    density: Density
    noise: float
    rng: np.random.Generator

    @property
    def points(self) -> Float:
        """The points, of shape (N, 3)."""
        return self.density.points

    @property
    def radius(self) -> float:
        """Radius of their disks."""
        return self.density.radius

    def left(self, found: list[Face]) -> Int:
        """Return the rows of the points that are on none of some faces."""
        free = np.ones(len(self.points), dtype=bool)
        for face in found:
            free[face.rows] = False
        return np.flatnonzero(free)

    def share(self, found: list[Face]) -> float:
        """Return the share of the points that are on some faces."""
        return 1.0 - len(self.left(found)) / len(self.points)

    def all(self, points: Float, normals: Float, angle: float, found: list[Face]) -> list[Face]:
        """Return some faces, and those found among the points that are on none of them.

        Parameters
        ----------
        points, normals : arrays of shape (N, 3), averaged, which propose surfaces
        angle : degrees between a point's normal and its surface's, at most
        found : the faces that are there already
        """
        for _ in range(ROUNDS):
            rest = self.left(found)
            some = np.sort(self.rng.permutation(rest)[:SOUGHT])
            radius = self.radius * float(np.sqrt(len(rest) / max(len(some), 1)))
            off = max(self.noise, SEARCH * self.radius)
            wanted = Wanted(angle, spheres=True, touches=(TOUCHES, TOUCHES))
            everything = np.ones(len(some), dtype=bool)
            proposed = surfaces(points[some], normals[some], everything, radius, off, self.rng, wanted)
            before = len(found)
            for one in sorted(proposed, key=lambda seen: -len(seen.points)):
                face = self._face(one, self.left(found), normals, angle, NEAR * radius)
                found = found if face is None else [*found, face]
            if len(found) == before:
                break
        return found

    def _face(self, seen: Seen, free: Int, normals: Float, angle: float, near: float) -> Face | None:
        """Return the face of a surface and those free points that it cannot be told from, or None if it can.

        Parameters
        ----------
        seen : Seen
        free : rows of points that are on no other face
        normals : array of shape (N, 3), averaged unit normals
        angle : degrees between them and the surface's, at most
        near : how far they are from those of the surface that were seen, at most
        """
        away = Density(seen.points).tree.query(self.points[free])[0]
        rows, beside = free[away < near], free[away < RING * near]
        points, theirs, surface = self.points[rows], normals[rows], seen.surface
        on = agreed(surface, points, theirs, OFF * self.noise, angle)
        for weight in WEIGHTS:
            if int(on.sum()) < LEAST:
                return None
            surface = surface.fitted(points[on], theirs[on], self.radius, weight)
            on = agreed(surface, points, theirs, OFF * self.noise, angle)
        if int(on.sum()) < LEAST or not self._is_noise(surface, points[on]):
            return None
        points, theirs = self.points[beside], normals[beside]
        aside = agreed(surface, points, theirs, ASIDE * self.noise, NEARLY)
        aside &= np.abs(surface.at(points)) > OFF * self.noise
        if int(aside.sum()) > BENDS * int(on.sum()):
            return None
        return Face(surface, rows[on])

    def _is_noise(self, surface: Primitive, points: Float) -> bool:
        """Return whether heights over a surface, at points of shape (K, 3), are but noise."""
        height = surface.at(points)
        size = float(np.sqrt(np.mean(height**2)))
        if size < EXACT * self.radius:
            return True
        return size < NO_MORE * self.noise and is_white(height, points, feet(surface, points))

    def laid(self, found: list[Face], points: Float, normals: Float) -> Laid:
        """Return the points on faces, and the others averaged, but for those that this moves farther than noise does.

        Parameters
        ----------
        found : the faces
        points, normals : arrays of shape (N, 3), averaged
        """
        far = np.linalg.norm(points - self.points, axis=1) > OFF * self.noise
        points, normals, on = np.where(far[:, None], self.points, points), normals.copy(), np.zeros(len(points), bool)
        faces = self._with_strays(found, normals)
        for face in faces:
            scanned = self.points[face.rows]
            normals[face.rows] = face.surface.normal(scanned)
            points[face.rows] = feet(face.surface, scanned)
            on[face.rows] = True
        return Laid(self._up_to_edges(faces, points), normals, on, len(found))

    def _up_to_edges(self, faces: list[Face], points: Float) -> Float:
        """Return laid points, of shape (N, 3), those beyond an edge moved back to it, along their face.

        Noise along a face takes some of its points beyond its edge. Where nearly all of them beside another face are on
        one side of that, the faces meet in an edge, and the others are beyond it.
        """
        owner = np.full(len(points), -1)
        for number, face in enumerate(faces):
            owner[face.rows] = number
        rows = np.flatnonzero(owner >= 0)
        away, near = Density(points[rows]).tree.query(points[rows], list(range(2, min(AROUND, len(rows)) + 1)))
        theirs = owner[rows][near]
        row, rank = np.nonzero((theirs != owner[rows, None]) & (away < NEAR * self.radius))
        pairs = np.unique(np.stack([owner[rows][row], theirs[row, rank], rows[row]]), axis=1)
        moved = points.copy()
        for one, other in np.unique(pairs[:2], axis=1).T:
            some = pairs[2][(pairs[0] == one) & (pairs[1] == other)]
            mine, across = faces[one].surface, faces[other].surface
            x = moved[some]
            height, cosine = across.at(x), np.einsum("kd,kd->k", mine.normal(x), across.normal(x))
            side = np.sign(np.median(height))
            beyond = (side * height < 0) & (np.abs(cosine) < cosine_of(NEARLY))
            if len(some) < LEAST or beyond.mean() > CROSSED:
                continue
            # Farther than noise takes points, there is more of the face.
            beyond &= np.abs(height) < OFF * self.noise
            x, height, cosine = x[beyond], height[beyond], cosine[beyond]
            along = across.normal(x) - cosine[:, None] * mine.normal(x)
            moved[some[beyond]] = feet(mine, x - (height / (1 - cosine**2))[:, None] * along)
        return moved

    def _with_strays(self, found: list[Face], normals: Float) -> list[Face]:
        """Return faces with the single points among theirs that are farther off, each on that which looks as it does.

        Near edges there are most of them. As they were scanned, they would make horns.
        """
        left = self.left(found)
        _, near = self.density.tree.query(self.points[left], list(range(2, BESIDE + 2)))
        single = np.isin(near, left, invert=True).mean(axis=1) > SINGLE
        rows = left[single]
        best, like = np.full(len(rows), -1), np.full(len(rows), cosine_of(NEARLY))
        for number, face in enumerate(found):
            points, theirs = self.points[rows], normals[rows]
            alike = np.einsum("kd,kd->k", face.surface.normal(points), theirs)
            close = Density(self.points[face.rows]).tree.query(points)[0] < NEAR * self.radius
            better = close & (np.abs(face.surface.at(points)) < ASIDE * self.noise) & (alike > like)
            best[better], like[better] = number, alike[better]
        return [Face(face.surface, np.append(face.rows, rows[best == number])) for number, face in enumerate(found)]


NOISE, MOST = 0.1, 0.2
"""Noise with which surfaces are looked for at least, and beyond which few points cannot tell a shape from them, in
radii of a disk."""

FLAT, LEVEL, ROOM = 10, 10.0, 1.5
"""Points of a neighbourhood whose thickness tells the noise; the percentile of all, which lies within faces even where
most points are near an edge; and by how much more noise is granted."""

FIRST, ESTIMATED_ANGLES = 20.0, (30.0, 40.0, 30.0, 40.0, 30.0)
"""Degrees between a point's normal and its surface's at most: first, and each time that normals were estimated anew."""

TURNED = 75.0
"""Degrees between a point's normal and that of a surface that it lies on at most, while normals can still improve."""

BEGUN = 0.3
"""Least share of the points on the first surfaces."""

ESTIMATED_BESIDE, ENOUGH, WITHIN = 6, 5, 3.0
"""Points from which a normal is estimated anew, how many of them must be near, and how near, in radii of a disk."""


# Points that came without normals, laid on the planes, round cylinders and spheres that they lie on.
#
# A normal that is estimated from a point's neighbours is wrong beside an edge, as some of them lie on the other face:
# on machine parts of some thousand points, at a third of the points and more. Those of a large face's middle are right,
# and tell the surface on which the others lie by where they are. What is left then are smaller faces, whose points are
# each other's neighbours now that those of the others are gone; their normals are estimated anew, and surfaces are
# looked for again. In the end a point that lies on a surface, among its points, belongs to it whatever its normal was.
#
# Neither do such normals tell the noise; the thickness of the flattest neighbourhoods does.


def laid_bare(points: Float, normals: Float) -> Laid | None:
    """Return the points of a made shape on its planes, cylinders and spheres, or None of any other shape.

    Parameters
    ----------
    points, normals : arrays of shape (N, 3), unit coordinates, outward unit normals, estimated from the points
    """
    if len(points) <= LEAST:
        return None
    density = Density(points)
    noise = _noise(density)
    if noise > MOST * density.radius:
        return None
    search = Search(density, noise, np.random.default_rng(0))
    found = search.all(points, normals, FIRST, [])
    if search.share(found) < BEGUN:
        return None
    anew = normals
    for angle in ESTIMATED_ANGLES:
        found = _by_place(search, found, anew, TURNED)
        anew = _anew(density, anew, search.left(found))
        found = search.all(points, anew, angle, found)
    found = _by_place(search, found, anew, 180.0)
    if search.share(found) < MADE:
        return None
    return search.laid(found, points, _anew(density, anew, search.left(found)))


def _noise(density: Density) -> float:
    """Return the noise with which surfaces are looked for, by how thick neighbourhoods within faces are."""
    near = density.tree.query(density.points, min(FLAT, len(density.points)))[1]
    least = principal_sums(density.points[near])[:, 0].clip(0.0)
    thick = np.sqrt(np.percentile(least, LEVEL) / (FLAT - 3))
    return max(float(ROOM * thick), NOISE * density.radius)


def _anew(density: Density, normals: Float, rest: Int) -> Float:
    """Return normals, of shape (N, 3), those of some rows estimated from these alone; their sides stay."""
    found = normals.copy()
    if len(rest) <= ESTIMATED_BESIDE:
        return found
    points = density.points[rest]
    away, near = cKDTree(points).query(points, ESTIMATED_BESIDE)
    enough = (away < WITHIN * density.radius).sum(axis=1) >= ENOUGH
    axes = plane_normals(points[near])
    sides = np.where(np.einsum("nd,nd->n", axes, normals[rest]) < 0, -1.0, 1.0)
    found[rest[enough]] = (sides[:, None] * axes)[enough]
    return found


def _by_place(search: Search, found: list[Face], normals: Float, turned: float) -> list[Face]:
    """Return faces with those other points that lie on them, among their points, each on the nearest.

    Parameters
    ----------
    search : that found the faces
    found : the faces
    normals : array of shape (N, 3), of the points
    turned : degrees between a point's normal and its surface's at most
    """
    rest = search.left(found)
    points, theirs = search.points[rest], normals[rest]
    owner, least = np.full(len(rest), -1), np.full(len(rest), np.inf)
    for number, face in enumerate(found):
        height = np.abs(face.surface.at(points))
        near = Density(search.points[face.rows]).tree.query(points)[0] < NEAR * search.radius
        on = near & agreed(face.surface, points, theirs, OFF * search.noise, turned) & (height < least)
        owner[on], least[on] = number, height[on]
    return [Face(face.surface, np.append(face.rows, rest[owner == number])) for number, face in enumerate(found)]
