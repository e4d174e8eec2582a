"""The winding number of open scenes, such as terrain or objects on a ground, made one that tells their two sides.

Across a surface the winding number changes by 1. With the principal value v at the surface itself, it is v + 1/2 just
inside: 1 where the surface is closed (v = 1/2), and 1/2 below a flat sheet (v = 0), inside of which there would be
nothing but a slab of no thickness, which tears. So the level that divides inside from outside is v next to the data.
Farther away it rises to the middle of v and 1/2, so that what is below a sheet ends about half of its extent down.

A point represents an area. Where points lie in strips, far denser along them than across, the disk up to the k-th
neighbour is a small part of it, and the winding number leaks between the strips. The areas of a sheet that was seen
from one side are those of the triangles between its points, seen from there, and so are their directions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gnrecon.geometry.arrays import Float, Int


@dataclass(frozen=True)
class WindingLevel:
    """The level of the winding number that divides inside from outside.

    Parameters
    ----------
    principal : median of the winding number's principal values at the points
    fade : distance from the data at which the level is half of the way to 1/2, unit coordinates: far more than the
        gaps between points, far less than a scene
    """

    principal: float = 0.5
    fade: float = 0.25

    @classmethod
    def at_points(cls, winding: Float, *, most_open: float = 0.15) -> WindingLevel:
        """Return the level for principal values, of shape (Q,); 1/2 unless their median is small.

        Half of a sphere has 0.3, and its inside is clear; sheets and scenes on the ground have less than 0.1.
        """
        middle = float(np.median(winding)) if len(winding) else 0.5
        return cls(middle) if abs(middle) < most_open else cls()

    @property
    def is_open(self) -> bool:
        """Whether it is not that of a closed surface."""
        return self.principal != 0.5

    def centred(self, winding: Float, distance: Float) -> Float:
        """Return winding numbers, of shape (Q,), moved so that 1/2 divides inside from outside, and 1/4 is certain.

        What is certain is half of the way from the level to the value just inside, or at a distance to that of free
        space far away, which is 0.

        Parameters
        ----------
        winding, distance : arrays of shape (Q,), winding numbers and distances to the data, unit coordinates
        """
        if not self.is_open:
            return winding
        far = np.minimum(distance / self.fade, 1.0)
        level = self.principal + far * (0.5 - self.principal) / 2
        margin = 0.25 - far * (0.25 - (self.principal + 0.5) / 4)
        return np.asarray(0.5 + (winding - level) * (0.25 / margin))


def sheet_dipoles(points: Float, normals: Float, disks: Float, *, least_facing: float = 0.97) -> tuple[Float, Float]:
    """Return directions, of shape (N, 3), and radii of disks, of shape (N,), that make up a sheet seen from one side.

    They are those of the triangles between points; the given ones where the surface was seen from several sides.

    Parameters
    ----------
    points, normals : arrays of shape (N, 3), outward unit normals
    disks : array of shape (N,), radius of the disk that each point represents
    least_facing : share of the normals within 90 degrees of their mean, of a sheet that was seen from one side
    """
    towards = normals.mean(axis=0)
    if (normals @ towards > 0).mean() < least_facing:
        return normals, disks
    triangles, _ = sheet_triangles(points, towards)
    if not len(triangles):
        return normals, disks
    a, b, c = (points[corner] for corner in triangles.T)
    # A third of each triangle belongs to each of its corners.
    shares, corners = np.repeat(np.cross(b - a, c - a) / 6, 3, axis=0), triangles.ravel()
    sums = np.column_stack([np.bincount(corners, share, len(points)) for share in shares.T])
    sizes = np.linalg.norm(sums, axis=1)
    used = sizes > 0
    return np.where(used[:, None], sums / np.where(used, sizes, 1.0)[:, None], normals), np.sqrt(sizes / np.pi)


def sheet_triangles(points: Float, towards: Float) -> tuple[Int, Float]:
    """Return the triangles between points as they are seen from one side, and the points as they are seen.

    Parameters
    ----------
    points : array of shape (N, 3)
    towards : array of shape (3,), the direction to that side

    Returns
    -------
    Rows of points, of shape (F, 3), counter-clockwise from that side, none of points on a line; and places in the
    plane, of shape (N, 2).
    """
    from scipy.spatial import Delaunay, QhullError

    flat: Float = points @ np.linalg.svd(towards[None])[2][1:].T
    try:
        triangles: Int = Delaunay(flat).simplices.astype(np.int64)
    except QhullError:
        return np.empty((0, 3), np.int64), flat
    a, b, c = (points[corner] for corner in triangles.T)
    away = np.cross(b - a, c - a) @ towards < 0
    triangles[away] = triangles[away][:, ::-1]
    return triangles, flat


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
