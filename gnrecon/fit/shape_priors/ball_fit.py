"""A scan of a ball, laid on it.

Of the smooth closed shapes only a sphere has no more unknowns than a few points tell. Where all points of a scan lie on
one, but for what can only be noise, from all around, they are laid on it, and where they leave gaps samples of the
sphere fill them: the fit is then as good between the points as at them, however few or noisy they are.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from gnrecon.fit.shape_priors.primitives import Sphere, feet
from gnrecon.fit.shape_priors.whiteness_test import is_white
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.point_cloud import Samples
from gnrecon.geometry.signed_distance import Density
from gnrecon.geometry.statistics import robust_deviation

LEAST = 30
"""Fewest points that could tell a sphere from a quadric by what is noise."""

OFF, EXACT = 5.0, 1e-6
"""How far off a point may lie, in deviations of the heights; and size of the heights below which they are rounding, in
radii of the sphere."""

NOISY = 0.5
"""Most deviation of the heights, in radii of a point's disk: of more, neighbours could be on another shape."""

TURNED = 45.0
"""Degrees between the direction of any place from the centre and that of the nearest point at most: a wider gap may be
where the shape is no ball, as under a dome."""

SAMPLES, APART = 1000, 0.6
"""Samples of a whole sphere at least, which lie evenly; and how far from every point one lies that fills a gap, in
their spacing. A thousand leave errors of 1e-6 of the radius."""


@dataclass(frozen=True)
class Ball:
    """A scan of a ball: the samples on it, those of the scan first, and its radius in file units."""

    samples: Samples
    radius: float

    @classmethod
    def of(cls, samples: Samples) -> Ball | None:
        """Return a scan's samples laid on a ball whose gaps are filled, or None where they could be of another shape.

        Their normals are those of the ball then.
        """
        points, normals = samples.points, samples.normals
        if len(points) < LEAST:
            return None
        density = Density(points)
        sphere = _first(points, normals).fitted(points, normals, density.radius, 0.0)
        height = sphere.at(points)
        size = robust_deviation(height)
        if sphere.side < 0 or np.abs(height).max() > max(OFF * size, EXACT * sphere.radius):
            return None
        if size > EXACT * sphere.radius and not (
            size < NOISY * density.radius and is_white(height, points, feet(sphere, points))
        ):
            return None
        outward = sphere.normal(points)
        tree, filled = cKDTree(outward), _directions(max(SAMPLES, len(points)))
        away = tree.query(filled)[0]
        if away.max() > 2 * np.sin(np.radians(TURNED) / 2):
            return None
        more = filled[away > APART * np.sqrt(4 * np.pi / len(filled))]
        directions = np.concatenate([outward, more])
        on = replace(samples, points=sphere.center + sphere.radius * directions, normals=directions, estimated=False)
        return cls(on, samples.frame.scale * sphere.radius)


def _first(points: Float, normals: Float) -> Sphere:
    """Return the sphere for which |x|^2 = 2 c . x + (r^2 - |c|^2) holds best, which is linear in what is not known."""
    terms = np.concatenate([2 * points, np.ones((len(points), 1))], axis=1)
    found = np.linalg.lstsq(terms, np.square(points).sum(axis=1), rcond=None)[0]
    center = found[:3]
    radius = float(np.sqrt(max(found[3] + center @ center, 0.0)))
    outward = np.einsum("nd,nd->", points - center, normals) > 0
    return Sphere(center, radius, 1.0 if outward else -1.0)


def _directions(count: int) -> Float:
    """Return evenly spread unit vectors, of shape (count, 3), along a spiral that turns by the golden angle."""
    height = 1 - (2 * np.arange(count) + 1) / count
    turn = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    across = np.sqrt(1 - height**2)
    return np.stack([across * np.cos(turn), across * np.sin(turn), height], axis=1)
