"""Snaps points that came without normals to the planes, round cylinders and spheres on which they lie.

A normal estimated from a point's neighbours is wrong near an edge, because some of them lie on the other face: on
machine parts of some thousand points, at a third of the points and more. Normals in the middle of a large face are
right, and find the surface on which the others lie by their positions. What is left are smaller faces, whose points are
each other's neighbours once those of the large ones are removed; their normals are estimated again, and primitives
are detected again. In the end a point that lies on a primitive, among its points, belongs to it whatever its normal.

Estimated normals do not show the noise; the thickness of the flattest neighbourhoods does.
Entry: `snap_unoriented_points`.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from gnrecon.fit.shape_priors.primitives import is_inlier
from gnrecon.fit.shape_priors.prior_parameters import UnorientedSnappingParameters
from gnrecon.fit.shape_priors.snapping import FaceSearch, PrimitiveFace, SnappedPoints
from gnrecon.geometry.arrays import Float, Int
from gnrecon.geometry.local_pca import plane_normals, principal_sums
from gnrecon.geometry.signed_distance import Density


def snap_unoriented_points(
    points: Float, normals: Float, parameters: UnorientedSnappingParameters = UnorientedSnappingParameters()
) -> SnappedPoints | None:
    """Return the points of a machine part on its planes, cylinders and spheres, or None of any other shape.

    Parameters
    ----------
    points, normals : arrays of shape (N, 3), unit coordinates, outward unit normals, estimated from the points
    parameters : of the snapping
    """
    p = parameters
    if len(points) <= p.snapping.detection.min_points:
        return None
    density = Density(points)
    noise = max(_face_noise(density), p.min_noise_radii * density.radius)
    if noise > p.max_noise_radii * density.radius:
        return None
    search = FaceSearch(density, noise, np.random.default_rng(0), p.snapping)
    found = search.detect(points, normals, p.first_degrees, [])
    if search.share(found) < p.min_first_share:
        return None
    estimated = normals
    for angle in p.later_degrees:
        found = _with_points_nearby(search, found, estimated, p.max_turn_degrees)
        estimated = _reestimated(density, estimated, search.left(found))
        found = search.detect(points, estimated, angle, found)
    found = _with_points_nearby(search, found, estimated, 180.0)  # whatever their normals
    if search.share(found) < p.snapping.min_snapped_share:
        return None
    return search.snap(found, points, _reestimated(density, estimated, search.left(found)))


def _face_noise(density: Density, *, neighbours: int = 10, percentile: float = 10.0, factor: float = 1.5) -> float:
    """Return the noise with which primitives are detected, by the thickness of neighbourhoods within faces.

    Parameters
    ----------
    density : of the points
    neighbours : of a point, whose deviation from a plane is its thickness
    percentile : of all thicknesses: within faces even where most points are near an edge
    factor : of tolerance over that thickness
    """
    near = density.tree.query(density.points, min(neighbours, len(density.points)))[1]
    least = principal_sums(density.points[near])[:, 0].clip(0.0)
    # A plane has three unknowns.
    return float(factor * np.sqrt(np.percentile(least, percentile) / (neighbours - 3)))


def _reestimated(
    density: Density,
    normals: Float,
    rest: Int,
    *,
    neighbours: int = 6,
    min_neighbours: int = 5,
    reach_radii: float = 3.0,
) -> Float:
    """Return normals, of shape (N, 3), those of some rows estimated from these alone, on the same side as before.

    Parameters
    ----------
    density : of the points
    normals : array of shape (N, 3)
    rest : the rows
    neighbours, min_neighbours : nearest rows of one, itself included, and how many of these must be near
    reach_radii : how near
    """
    found = normals.copy()
    if len(rest) <= neighbours:
        return found
    points = density.points[rest]
    away, near = cKDTree(points).query(points, neighbours)
    enough = (away < reach_radii * density.radius).sum(axis=1) >= min_neighbours
    axes = plane_normals(points[near])
    sides = np.where(np.einsum("nd,nd->n", axes, normals[rest]) < 0, -1.0, 1.0)
    found[rest[enough]] = (sides[:, None] * axes)[enough]
    return found


def _with_points_nearby(
    search: FaceSearch, found: list[PrimitiveFace], normals: Float, max_turn_degrees: float
) -> list[PrimitiveFace]:
    """Return faces with the other points that lie on them, among their points, each on the nearest face.

    Parameters
    ----------
    search : that found the faces
    found : the faces
    normals : array of shape (N, 3), of the points
    max_turn_degrees : between a point's normal and its primitive's
    """
    rest = search.left(found)
    points, own = search.points[rest], normals[rest]
    owner, least = np.full(len(rest), -1), np.full(len(rest), np.inf)
    for number, face in enumerate(found):
        height = np.abs(face.surface.signed_distance(points))
        near = Density(search.points[face.rows]).tree.query(points)[0] < search.parameters.reach_radii * search.radius
        on = near & is_inlier(face.surface, points, own, search.max_height, max_turn_degrees) & (height < least)
        owner[on], least[on] = number, height[on]
    return [
        PrimitiveFace(face.surface, np.append(face.rows, rest[owner == number])) for number, face in enumerate(found)
    ]
