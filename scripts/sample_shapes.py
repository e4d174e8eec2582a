"""The shapes of sample_data, as signed distance functions in millimetres.

A shape is a function of points of shape (N, 3) to values of shape (N,), negative inside. Parts are exact distances,
joined by polynomial smooth minima, so every edge is a fillet. A smooth minimum is no exact distance away from the
surface: divide by the length of the gradient for a first-order distance.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import KDTree

Float = npt.NDArray[np.float64]
Distance = Callable[[Float], Float]


@dataclass(frozen=True)
class Shape:
    """A solid: its distance function, a box that holds it (corners `low` and `high`, mm) and its surface's genus."""

    distance: Distance
    low: tuple[float, float, float]
    high: tuple[float, float, float]
    genus: int


def smooth_union(a: Float, b: Float, fillet: float) -> Float:
    """Return the union of two distances; within `fillet` of a tie, a parabola that meets both with equal slopes."""
    overlap = np.maximum(fillet - np.abs(a - b), 0.0)
    return np.minimum(a, b) - overlap**2 / (4.0 * fillet)


def smooth_cut(solid: Float, tool: Float, fillet: float) -> Float:
    """Return `solid` without `tool`, the rim rounded by `fillet`."""
    return -smooth_union(-solid, tool, fillet)


def extrude(outline: Float, along: Float, half_length: float, edge: float) -> Float:
    """Return the prism over the planar distance `outline`, for |along| <= half_length, edges rounded by `edge`."""
    sideways, lengthways = outline + edge, np.abs(along) - half_length + edge
    outside = np.hypot(np.maximum(sideways, 0.0), np.maximum(lengthways, 0.0))
    return np.minimum(np.maximum(sideways, lengthways), 0.0) + outside - edge


def circle(u: Float, v: Float, radius: float) -> Float:
    """Return the planar distance to a disc around the origin."""
    return np.hypot(u, v) - radius


def rectangle(u: Float, v: Float, half_u: float, half_v: float, corner: float) -> Float:
    """Return the planar distance to a rectangle with corners rounded by `corner`."""
    return extrude(np.abs(u) - half_u, v, half_v, corner)


def trapezoid(u: Float, v: Float, foot: tuple[float, float], head: tuple[float, float]) -> Float:
    """Return a planar distance to the trapezoid between two (half width, height) pairs, mirrored in u."""
    run, rise = head[0] - foot[0], head[1] - foot[1]
    flank = ((np.abs(u) - foot[0]) * rise - (v - foot[1]) * run) / float(np.hypot(run, rise))
    return np.maximum(flank, np.maximum(foot[1] - v, v - head[1]))


def bracket_distance(points: Float) -> Float:
    """Return the distance to a bearing bracket: a bored housing on a ribbed foot with four bolt holes."""
    x, y, z = points.T
    bolt_x, bolt_y = np.abs(x) - 47.0, np.abs(y) - 24.0
    housing_z = z - 60.0

    solid = extrude(rectangle(x, y, 62.0, 38.0, 14.0), z - 5.0, 5.0, 1.5)
    solid = smooth_union(solid, extrude(circle(bolt_x, bolt_y, 11.0), z - 10.0, 4.0, 1.0), 5.0)
    web = extrude(trapezoid(x, z, (54.0, 6.0), (27.0, 66.0)), y, 6.5, 1.5)
    web = smooth_cut(web, circle(np.abs(x) - 33.0, z - 26.0, 7.5), 2.0)
    rib = extrude(trapezoid(y, z, (33.0, 6.0), (17.0, 50.0)), x, 5.0, 1.5)
    solid = smooth_union(smooth_union(solid, web, 6.0), rib, 6.0)
    solid = smooth_union(solid, extrude(circle(x, housing_z, 30.0), y, 22.0, 2.0), 7.0)
    solid = smooth_union(solid, extrude(circle(x, y, 8.0), z - 92.0, 8.0, 1.0), 5.0)

    solid = smooth_cut(solid, circle(x, housing_z, 17.0), 2.0)
    seat = extrude(circle(x, housing_z, 23.0), np.abs(y) - 22.0, 6.0, 1.0)
    solid = smooth_cut(solid, seat, 2.0)
    solid = smooth_cut(solid, circle(bolt_x, bolt_y, 5.5), 1.5)
    oil_hole = extrude(circle(x, y, 3.5), z - 90.0, 20.0, 0.5)
    return smooth_cut(solid, oil_hole, 1.5)


def trefoil(samples: int, scale: float) -> tuple[Float, Float]:
    """Return points on a trefoil knot, of shape (samples, 3), and their parameters; it stands on two of its lobes."""
    t = np.linspace(0.0, 2.0 * np.pi, samples, endpoint=False)
    curve = np.stack(
        [np.sin(t) + 2.0 * np.sin(2.0 * t), 1.3 * np.sin(3.0 * t), 2.0 * np.cos(2.0 * t) - np.cos(t)], axis=1
    )
    return scale * curve, t


def knot_distance(points: Float) -> Float:
    """Return the distance to a trefoil of swelling thickness that stands on a stepped round plinth."""
    curve, t = trefoil(8192, 13.0)
    away, nearest = KDTree(curve + np.array([0.0, 0.0, 45.0])).query(points)
    knot = away - (6.0 + 1.2 * np.cos(3.0 * t[nearest]))
    x, y, z = points.T
    plinth = extrude(circle(x, y, 42.0), z - 4.0, 4.0, 1.5)
    plinth = smooth_union(plinth, extrude(circle(x, y, 36.0), z - 10.0, 4.0, 1.5), 2.0)
    return smooth_union(knot, plinth, 7.0)


SHAPES = {
    "bracket": Shape(bracket_distance, (-64.0, -40.0, -2.0), (64.0, 40.0, 102.0), genus=8),
    "knot": Shape(knot_distance, (-45.0, -45.0, -2.0), (45.0, 45.0, 94.0), genus=2),
}


def gradient(distance: Distance, points: Float, step: float = 1e-3) -> Float:
    """Return the gradient of `distance` at `points`, of shape (N, 3), by central differences over `step` mm."""
    shifts = step * np.eye(3)
    return np.stack([distance(points + s) - distance(points - s) for s in shifts], axis=1) / (2.0 * step)


def project(distance: Distance, points: Float, steps: int = 3) -> Float:
    """Return `points` moved onto the surface by Newton's method along the gradient."""
    for _ in range(steps):
        slope = gradient(distance, points)
        points = points - (distance(points) / (slope**2).sum(axis=1))[:, None] * slope
    return points
