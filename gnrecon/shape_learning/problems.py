"""Plateau's problem: the minimal surface in a given curve, k1 + k2 = 0.

The paper's two have known solutions: the catenoid between two circles of radius cosh 1 at z = -1 and 1, and Enneper's
surface within its boundary curve of parameter radius 0.9. Its terms are the interface, f = 0 on the curves, and the
mean curvature on the surface within the box, both with weight one (see `through_curves`).

Once the surface has its shape, its distance from the known one is about the residual on the curves. So the weight of
the interface rises from one to fifty after forty steps. The reported loss has the paper's weights.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from gnrecon import level_set
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.signed_distance import Box
from gnrecon.residuals import SecondOrder, eikonal, gauss_curvature, interface, mean_curvature
from gnrecon.runtime.errors import UsageError
from gnrecon.shape_learning.learning_parameters import CurveParameters, ShapeLearningParameters
from gnrecon.shape_learning.shape_problem import (
    ShapeProblem,
    Start,
    Term,
    Weight,
    at_points,
    circle,
    cube,
    fading,
    in_box,
    on_surface,
    plane_through,
    rising,
    z_cylinder,
    z_plane,
)


def minimal_surface(
    curve: npt.ArrayLike,
    *,
    start: Start | None = None,
    box: Box | None = None,
    name: str = "minimal surface",
    parameters: CurveParameters = ShapeLearningParameters.curves,
) -> ShapeProblem:
    """Return the problem of a minimal surface through curves.

    Parameters
    ----------
    curve : points of the curves, of shape (N, 3), close together
    start : a function of the wanted topology, by default the distance to the plane that fits the curve best
    box : where the surface is minimal, by default the curve's bounding box and a quarter of its longest side more

    Raises
    ------
    UsageError
        When there are fewer than three points, or they are not finite.
    """
    weight = rising(1.0, parameters.weight_hold_steps, parameters.weight_growth, parameters.most_weight)
    return through_curves(name, curve, mean_curvature, start, box, weight, parameters=parameters)


def catenoid() -> ShapeProblem:
    """Return the paper's catenoid problem; the part between the circles is meshed."""
    points = np.concatenate([circle(np.cosh(1.0), height) for height in (-1.0, 1.0)])
    problem = minimal_surface(points, start=z_cylinder(), box=cube(2.0), name="catenoid")
    between = Box(np.array([-2.0, -2.0, -1.0]), np.array([2.0, 2.0, 1.0]))
    return replace(problem, known=level_set.catenoid(), shown=between)


def enneper(radius: float = 0.9) -> ShapeProblem:
    """Return the paper's problem of Enneper's surface; all that is in the box is meshed."""
    t = 2 * np.pi * np.arange(1000) / 1000
    x = radius * np.cos(t) - radius**3 * np.cos(3 * t) / 3
    y = radius * np.sin(t) + radius**3 * np.sin(3 * t) / 3
    curve = np.stack([x, y, radius**2 * np.cos(2 * t)], axis=1)
    problem = minimal_surface(curve, start=z_plane, box=cube(1.0), name="enneper")
    return replace(problem, known=level_set.enneper(radius))


# Developable surfaces, k1 k2 = 0: those that unroll into the plane without stretching.
#
# The paper's is the mantle of a truncated cone between a circle of radius 1 at z = 0 and one of radius 0.4 at z = 1.
# The terms are those of a minimal surface with the Gauss curvature instead of the mean curvature. Where a surface is
# flat the Gauss curvature vanishes to second order and its derivative is zero, so the start matters more: the problem
# has other solutions, such as two planes.


def developable_surface(
    curve: npt.ArrayLike,
    *,
    start: Start | None = None,
    box: Box | None = None,
    name: str = "developable surface",
    parameters: CurveParameters = ShapeLearningParameters.curves,
) -> ShapeProblem:
    """Return the problem of a developable surface through curves.

    Parameters
    ----------
    curve : points of the curves, of shape (N, 3), close together
    start : a function of the wanted topology, by default the distance to the plane that fits the curve best
    box : where the surface is developable, by default the curve's bounding box and a quarter of its longest side more

    Raises
    ------
    UsageError
        When there are fewer than three points, or they are not finite.
    """
    return through_curves(name, curve, gauss_curvature, start, box, parameters=parameters)


def cone() -> ShapeProblem:
    """Return the paper's problem of the cone; the mantle between the circles is meshed."""
    curves = np.concatenate([circle(1.0, 0.0), circle(0.4, 1.0)])
    problem = developable_surface(curves, start=z_cylinder(), box=cube(1.0), name="cone")
    mantle = Box(np.array([-1.0, -1.0, 0.0]), np.array([1.0, 1.0, 1.0]))
    return replace(problem, known=level_set.cone(), shown=mantle)


# Surfaces through given curves: f = 0 on the curves, and one residual of curvature on the surface.
#
# Neither determines the slope of the field, and a field whose slope vanishes on a curve satisfies the first without
# moving the surface. So the eikonal term starts with a weight of one and fades to zero within about thirty steps; in
# the paper it starts with 1e-3 and ends after 500 steps.


def through_curves(
    name: str,
    curve: npt.ArrayLike,
    curvature: SecondOrder,
    start: Start | None,
    box: Box | None,
    weight: float | Weight = 1.0,
    *,
    parameters: CurveParameters = ShapeLearningParameters.curves,
) -> ShapeProblem:
    """Return the problem of a surface through curves on which a residual of curvature vanishes.

    Parameters
    ----------
    name : of the problem
    curve : points of the curves, of shape (N, 3), close together
    curvature : the residual
    start : a function of the wanted topology, by default the distance to the plane that fits the curve best
    box : where the curvature vanishes, by default the curve's bounding box and a quarter of its longest side more
    weight : of f = 0 on the curves; one in the reported loss
    parameters : points, weights and margins

    Raises
    ------
    UsageError
        When there are fewer than three points, or they are not finite.
    """
    points = curve_points(curve)
    eikonal_weight = fading(1.0, parameters.eikonal_hold_steps, parameters.eikonal_factor)
    terms = (
        Term("interface", interface, at_points(points, count=parameters.curve_points), weight, reported=1.0),
        Term(curvature.name, curvature, on_surface(parameters.surface_points)),
        Term("eikonal", eikonal, in_box(parameters.box_points), eikonal_weight),
    )
    box = box or box_around(points, parameters.box_margin_sides)
    return ShapeProblem(name, terms, box, start or plane_through(points))


def curve_points(curve: npt.ArrayLike) -> Float:
    """Return a curve's points, of shape (N, 3).

    Raises
    ------
    UsageError
        When there are fewer than three points, or they are not finite.
    """
    points = np.asarray(curve, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) < 3 or not np.isfinite(points).all():
        raise UsageError(f"A curve is three or more finite points of shape (N, 3), not {points.shape}.")
    return points


def box_around(points: Float, margin_sides: float = CurveParameters.box_margin_sides) -> Box:
    """Return a box around a curve, with a margin in longest sides of the curve."""
    return Box.around(points, margin_sides * float((points.max(axis=0) - points.min(axis=0)).max()))
