"""Plateau's problem: the minimal surface in a given curve, k1 + k2 = 0.

The paper's two have known solutions: the catenoid between two circles of radius cosh 1 at z = -1 and 1, and Enneper's
surface within its boundary curve of parameter radius 0.9. Its terms are the interface, f = 0 on the curves, and the
mean curvature on the surface within the box, both of weight one.

Neither says what the field's slope is, and a field that shrinks on a curve satisfies the first without moving its
surface. So the eikonal term begins with a weight of one and fades over some thirty steps to nothing; the paper's
begins with 1e-3 and ends after 500 steps.

Once the surface has its shape, its distance from the known one is about the residual on the curves. So the interface's
weight rises after forty steps, to fifty; the loss that is reported has the paper's weights.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from gnrecon import levelset
from gnrecon.cloud import Float
from gnrecon.errors import UsageError
from gnrecon.residuals import eikonal, interface, mean_curvature
from gnrecon.sampling import Box
from gnrecon.shapes.problem import ShapeProblem, Start, circle, cube, plane_through, z_cylinder, z_plane
from gnrecon.shapes.term import Term, Weight, at_points, fading, in_box, on_surface, rising

ON_SURFACE, ON_CURVE, IN_BOX = 2000, 500, 300
"""Points of each term at each step."""

HOLD, FACTOR = 10, 0.7
"""Steps for which the eikonal term keeps its weight, and its factor from step to step after them."""

RISE = 40, 1.1, 50.0
"""Steps for which the interface keeps the weight one, its factor from step to step after them, and its most."""

MARGIN = 0.25
"""How far the box reaches beyond a curve, as a share of the curve's longest side."""


def minimal_surface(
    curve: npt.ArrayLike, *, start: Start | None = None, box: Box | None = None, name: str = "minimal surface"
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
    points = curve_points(curve)
    return ShapeProblem(
        name,
        (
            interface_term(points, rising(1.0, *RISE)),
            Term("mean curvature", mean_curvature, on_surface(ON_SURFACE)),
            eikonal_term(),
        ),
        box or box_around(points),
        start or plane_through(points),
    )


def catenoid() -> ShapeProblem:
    """Return the paper's catenoid problem; the part between the circles is meshed."""
    points = np.concatenate([circle(np.cosh(1.0), height) for height in (-1.0, 1.0)])
    problem = minimal_surface(points, start=z_cylinder(), box=cube(2.0), name="catenoid")
    return _known(problem, levelset.catenoid(), Box(np.array([-2.0, -2.0, -1.0]), np.array([2.0, 2.0, 1.0])))


def enneper(radius: float = 0.9) -> ShapeProblem:
    """Return the paper's problem of Enneper's surface; all that is in the box is meshed."""
    t = 2 * np.pi * np.arange(1000) / 1000
    x = radius * np.cos(t) - radius**3 * np.cos(3 * t) / 3
    y = radius * np.sin(t) + radius**3 * np.sin(3 * t) / 3
    curve = np.stack([x, y, radius**2 * np.cos(2 * t)], axis=1)
    problem = minimal_surface(curve, start=z_plane, box=cube(1.0), name="enneper")
    return _known(problem, levelset.enneper(radius), cube(1.0))


def _known(problem: ShapeProblem, known: levelset.ParametricSurface, shown: Box) -> ShapeProblem:
    return ShapeProblem(problem.name, problem.terms, problem.box, problem.start, problem.network, known, shown)


def interface_term(points: Float, weight: float | Weight = 1.0) -> Term:
    """Return f = 0 on a curve, with weight one in the reported loss."""
    return Term("interface", interface, at_points(points, count=ON_CURVE), weight, reported=1.0)


def eikonal_term(hold: int = HOLD) -> Term:
    """Return the eikonal term that keeps the field's slope while the surface finds its place."""
    return Term("eikonal", eikonal, in_box(IN_BOX), fading(1.0, hold, FACTOR))


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


def box_around(points: Float) -> Box:
    """Return a box around a curve."""
    return Box.around(points, MARGIN * float((points.max(axis=0) - points.min(axis=0)).max()))
