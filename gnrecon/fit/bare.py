"""Points that came without normals, laid on the planes, round cylinders and spheres that they lie on.

A normal that is estimated from a point's neighbours is wrong beside an edge, as some of them lie on the other face: on
machine parts of some thousand points, at a third of the points and more. Those of a large face's middle are right, and
tell the surface on which the others lie by where they are. What is left then are smaller faces, whose points are each
other's neighbours now that those of the others are gone; their normals are estimated anew, and surfaces are looked for
again. In the end a point that lies on a surface, among its points, belongs to it whatever its normal was.

Neither do such normals tell the noise; the thickness of the flattest neighbourhoods does.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from gnrecon.fit.laid import MADE, NEAR, OFF, Face, Laid, Search
from gnrecon.fit.primitives import LEAST, agreed
from gnrecon.geometry.arrays import Float, Int
from gnrecon.geometry.signed_distance import Density

NOISE, MOST = 0.1, 0.2
"""Noise with which surfaces are looked for at least, and beyond which few points cannot tell a shape from them, in
radii of a disk."""

FLAT, LEVEL, ROOM = 10, 10.0, 1.5
"""Points of a neighbourhood whose thickness tells the noise; the percentile of all, which lies within faces even where
most points are near an edge; and by how much more noise is granted."""

FIRST, ANGLES = 20.0, (30.0, 40.0, 30.0, 40.0, 30.0)
"""Degrees between a point's normal and its surface's at most: first, and each time that normals were estimated anew."""

TURNED = 75.0
"""Degrees between a point's normal and that of a surface that it lies on at most, while normals can still improve."""

BEGUN = 0.3
"""Least share of the points on the first surfaces."""

BESIDE, ENOUGH, WITHIN = 6, 5, 3.0
"""Points from which a normal is estimated anew, how many of them must be near, and how near, in radii of a disk."""


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
    for angle in ANGLES:
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
    spread = density.points[near] - density.points[near].mean(axis=1, keepdims=True)
    least = np.linalg.eigvalsh(np.einsum("nki,nkj->nij", spread, spread))[:, 0].clip(0.0)
    thick = np.sqrt(np.percentile(least, LEVEL) / (FLAT - 3))
    return max(float(ROOM * thick), NOISE * density.radius)


def _anew(density: Density, normals: Float, rest: Int) -> Float:
    """Return normals, of shape (N, 3), those of some rows estimated from these alone; their sides stay."""
    found = normals.copy()
    if len(rest) <= BESIDE:
        return found
    points = density.points[rest]
    away, near = cKDTree(points).query(points, BESIDE)
    enough = (away < WITHIN * density.radius).sum(axis=1) >= ENOUGH
    spread = points[near] - points[near].mean(axis=1, keepdims=True)
    axes = np.linalg.eigh(np.einsum("nki,nkj->nij", spread, spread))[1][:, :, 0]
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
