"""What the points of a sheet support between them: steep parts that were not seen, as the sides of raised letters.

A sheet was seen from one side. From there, two points next to each other show that the surface joins them, however far
one lies behind the other. So the triangles between neighbours, as they are seen from that side, support it too.
"""

from __future__ import annotations

import numpy as np

from gnrecon.export.metrics import nearest_on_surface
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.open_scenes import sheet_triangles


def distances_between_points(
    mesh: Mesh,
    distances: Float,
    points: Float,
    normals: Float,
    reach: float,
    *,
    most_gap_reaches: float = 2.0,
    least_cosine: float = 0.25,
) -> Float:
    """Return distances to the data of a sheet, of shape (V,), to which triangles between its points belong.

    Parameters
    ----------
    mesh : Mesh
        With V vertices.
    distances : array of shape (V,)
        From each vertex to the nearest scanned point that supports it, in file units.
    points, normals : arrays of shape (N, 3)
        Scanned points, in file units, and their outward unit normals, nearly all on one side.
    reach : float
        Distance at which support ends, in file units.
    most_gap_reaches : float
        Longest edge of such a triangle, as it is seen; with two, no point between them is farther than the reach.
    least_cosine : float
        Of the angle between the surface and a triangle that supports it.
    """
    far = np.flatnonzero(distances > reach)
    triangles, flat = sheet_triangles(points, normals.mean(axis=0))
    edges = np.linalg.norm(flat[triangles] - flat[np.roll(triangles, 1, axis=1)], axis=2)
    triangles = triangles[edges.max(axis=1) <= most_gap_reaches * reach]
    if not len(far) or not len(triangles):
        return distances
    sheet = Mesh(points, triangles)
    gaps, faces = nearest_on_surface(sheet, mesh.vertices[far])
    facing = sheet.face_vectors[faces]
    cosines = np.einsum("gi,gi->g", facing, mesh.vertex_normals()[far]) / np.maximum(
        np.linalg.norm(facing, axis=1), np.finfo(np.float64).tiny
    )
    result = distances.copy()
    result[far] = np.where(cosines > least_cosine, np.minimum(result[far], gaps), result[far])
    return result


def spacing_ratio(
    points: Float, normals: Float, *, neighbours: int = 8, most_points: int = 100_000, least_ratio: float = 1.25
) -> float:
    """Return the typical spacing of a sheet's points, in the median over its area, over that in the median of points.

    It is 1 where the points are even, and more where most of them lie in strips, far denser along them than across.

    Parameters
    ----------
    points, normals : arrays of shape (N, 3)
        Scanned points, and their outward unit normals, nearly all on one side.
    neighbours : int
        Up to which a point's spacing is measured.
    most_points : int
        Points that are looked at, chosen at random.
    least_ratio : float
        Smaller ratios are 1: random points have up to 1.1.
    """
    from scipy.spatial import cKDTree

    points = points[np.random.default_rng(0).permutation(len(points))[:most_points]]
    triangles, flat = sheet_triangles(points, normals.mean(axis=0))
    if not len(triangles):
        return 1.0
    radii = cKDTree(points).query(points, min(neighbours + 1, len(points)))[0][:, -1]
    sides = flat[triangles[:, 1:]] - flat[triangles[:, :1]]
    areas = np.abs(np.linalg.det(sides))
    order = np.argsort(radii)
    shares = np.cumsum(np.bincount(triangles.ravel(), np.repeat(areas, 3), len(points))[order])
    middle = radii[order[np.searchsorted(shares, shares[-1] / 2)]]
    ratio = float(middle / max(float(np.median(radii)), np.finfo(np.float64).tiny))
    return ratio if ratio > least_ratio else 1.0
