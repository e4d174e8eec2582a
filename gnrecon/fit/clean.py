"""Scans so clean that their noise need not be chosen.

Two neighbours of a smooth surface lie nearly as high over each other's tangent planes, with opposite signs: half the
sum of both heights is nothing on planes, spheres and round cylinders, and of third order in their distance elsewhere.
Noise is of order zero there, and that of the normals of order one. So points tell by themselves, without a surface,
how noisy they are. Left-out points tell it of clean scans hardly at all: they lie a spacing away from the others, where
the shape that is not known matters far more than a noise of a hundredth of that.
"""

from __future__ import annotations

import numpy as np

from gnrecon.fit.creases import over_planes
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.signed_distance import Density

Noise = tuple[float, float]

NEIGHBOURS, DISKS = 5, 2.0
"""Neighbours of a point that are asked, and how far they are at most, in radii of its disk."""

ALIKE = np.cos(np.radians(25.0))
"""Cosine of the angle between two normals up to which they may belong to one smooth piece of surface."""

CLEAN = 0.04
"""Median of the heights, in radii of a disk or over the distance where that is longer, up to which a scan is clean.
Vertices of scanned meshes have 0.017 to 0.024, a noise of 0.08 radii 0.06, range scans 0.14 and more."""

LEAST_PAIRS, MOST_POINTS = 20, 50_000
"""Fewest pairs that tell anything, and points whose neighbours are asked at most."""

LEAST_OVER = 0.01
"""Root mean square of what the global field leaves over, in radii of a disk, below which there is nothing to gain."""

POSITION, ANGLE, TURNED = 0.005, 0.01, 2.0
"""Least noise that is believed of positions, in radii of a disk, and of normals, in radians, and the latter over the
former: where neighbours stand a radius apart, noise of the normals alone would make such heights."""

ESTIMATED = 0.1
"""Noise of normals that were estimated, in radians: their error, which no neighbours tell, as theirs is about the same.
"""


def clean_noise(points: Float, normals: Float, density: Density, over: float, estimated: bool) -> Noise | None:
    """Return the noise of positions, unit coordinates, and normals, radians, of a clean scan; None of any other.

    It is also None where a field that is to be corrected leaves nothing over at the points.

    Parameters
    ----------
    points, normals : arrays of shape (N, 3), unit normals
    density : of the points
    over : root mean square of what is left over, unit coordinates
    estimated : whether the normals were found from the points
    """
    if over < LEAST_OVER * density.radius:
        return None
    height = heights(points, normals, density)
    if not height <= CLEAN:
        return None
    if estimated:
        return POSITION * density.radius, ESTIMATED
    return max(height, POSITION) * density.radius, max(TURNED * height, ANGLE)


def heights(points: Float, normals: Float, density: Density) -> float:
    """Return the median height of neighbours over the surface that both their normals tell; NaN of too few pairs.

    It is half the sum of both heights over each other's planes, over the larger of their distance and a disk's radius.
    The parameters are those of `clean_noise`.
    """
    asked = slice(None, None, -(-len(points) // MOST_POINTS))
    disks = density.disks[asked, None]
    ranks = list(range(2, min(NEIGHBOURS + 1, len(points)) + 1))
    distance, near = density.tree.query(points[asked], ranks)
    cosine = np.einsum("ikd,id->ik", normals[near], normals[asked])
    paired = (distance > 0) & (distance < DISKS * disks) & (cosine > ALIKE)
    if paired.sum() < LEAST_PAIRS:
        return np.nan
    height, own = over_planes(points, normals, asked, near)
    return float(np.median((np.abs(height - own) / 2 / np.maximum(distance, disks))[paired]))
