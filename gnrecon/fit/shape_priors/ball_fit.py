"""Fits a sphere to scans of a ball.

A sphere is the only smooth closed shape that a few points determine completely. Where all points of a scan lie on one
up to white noise, and cover all directions, they are projected onto it, and the gaps between them are filled with its
samples. The fit is then as good between the points as at them, however few or noisy they are.
Entry: `BallFit.of`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from gnrecon.fit.shape_priors.primitives import Sphere, project
from gnrecon.fit.shape_priors.prior_parameters import BallFitParameters
from gnrecon.fit.shape_priors.whiteness_test import is_white_noise
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.point_cloud import Samples
from gnrecon.geometry.signed_distance import Density
from gnrecon.geometry.statistics import robust_deviation


@dataclass(frozen=True)
class BallFit:
    """A scan of a ball: the samples on it, those of the scan first, and its radius in file units."""

    samples: Samples
    radius: float

    @classmethod
    def of(cls, samples: Samples, parameters: BallFitParameters = BallFitParameters()) -> BallFit | None:
        """Return a scan's samples on a ball, with its gaps filled, or None where they could be of another shape.

        Their normals are those of the ball.
        """
        points = samples.points
        if len(points) < parameters.min_points:
            return None
        sphere = _fitted_sphere(points, samples.normals, parameters)
        if sphere is None:
            return None
        outward = sphere.normal(points)
        tree, filled = cKDTree(outward), _fibonacci_directions(max(parameters.min_samples, len(points)))
        away = tree.query(filled)[0]
        # The distance of two unit vectors is twice the sine of half the angle between them.
        if away.max() > 2 * np.sin(np.radians(parameters.max_gap_degrees) / 2):
            return None
        more = filled[away > parameters.min_spacing_share * np.sqrt(4 * np.pi / len(filled))]
        directions = np.concatenate([outward, more])
        on = samples.replaced(sphere.center + sphere.radius * directions, directions)
        return cls(replace(on, estimated=False), samples.frame.scale * sphere.radius)


def _fitted_sphere(points: Float, normals: Float, parameters: BallFitParameters) -> Sphere | None:
    """Return the sphere of points and normals, both of shape (N, 3), or None where more than noise is off it."""
    radius = Density(points).radius
    sphere = _algebraic_fit(points, normals).refitted(points, normals, radius, 0.0)
    height = sphere.signed_distance(points)
    size, exact = robust_deviation(height), parameters.exact_share * sphere.radius
    if sphere.side < 0 or np.abs(height).max() > max(parameters.max_height_deviations * size, exact):
        return None
    noisy = size > exact
    if noisy and not (
        size < parameters.max_noise_radii * radius and is_white_noise(height, points, project(sphere, points))
    ):
        return None
    return sphere


def _algebraic_fit(points: Float, normals: Float) -> Sphere:
    """Return the sphere of least squares of |x|^2 - 2 c . x - (r^2 - |c|^2), which is linear in the unknowns."""
    terms = np.concatenate([2 * points, np.ones((len(points), 1))], axis=1)
    found = np.linalg.lstsq(terms, np.square(points).sum(axis=1), rcond=None)[0]
    center = found[:3]
    radius = float(np.sqrt(max(found[3] + center @ center, 0.0)))
    outward = np.einsum("nd,nd->", points - center, normals) > 0
    return Sphere(center, radius, 1.0 if outward else -1.0)


def _fibonacci_directions(count: int) -> Float:
    """Return evenly spread unit vectors, of shape (count, 3), along a spiral that turns by the golden angle."""
    height = 1 - (2 * np.arange(count) + 1) / count
    turn = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    across = np.sqrt(1 - height**2)
    return np.stack([across * np.cos(turn), across * np.sin(turn), height], axis=1)
