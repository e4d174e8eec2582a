"""Surfaces through given curves: f = 0 on the curves, and one residual of curvature on the surface.

Neither says what the field's slope is, and a field that shrinks on a curve satisfies the first without moving its
surface. So the eikonal term begins with a weight of one and fades over some thirty steps to nothing; the paper's
begins with 1e-3 and ends after 500 steps.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from gnrecon.geometry.arrays import Float
from gnrecon.geometry.signed_distance import Box
from gnrecon.residuals import SecondOrder, eikonal, interface
from gnrecon.runtime.errors import UsageError
from gnrecon.shapes.problem import ShapeProblem, Start, plane_through
from gnrecon.shapes.term import Term, Weight, at_points, fading, in_box, on_surface

ON_SURFACE, ON_CURVE, IN_BOX = 2000, 500, 300
"""Points of each term at each step."""

HOLD, FACTOR = 10, 0.7
"""Steps for which the eikonal term keeps its weight, and its factor from step to step after them."""

MARGIN = 0.25
"""How far the box reaches beyond a curve, as a share of the curve's longest side."""


def through_curves(
    name: str,
    curve: npt.ArrayLike,
    curvature: SecondOrder,
    start: Start | None,
    box: Box | None,
    weight: float | Weight = 1.0,
) -> ShapeProblem:
    """Return the problem of a surface through curves on which a residual of curvature vanishes.

    Parameters
    ----------
    name : of the problem
    curve : points of the curves, of shape (N, 3), close together
    curvature : the residual
    start : a function of the wanted topology, by default the distance to the plane that fits the curve best
    box : where the curvature vanishes, by default the curve's bounding box and a quarter of its longest side more
    weight : of f = 0 on the curves; the reported loss has one

    Raises
    ------
    UsageError
        When there are fewer than three points, or they are not finite.
    """
    points = curve_points(curve)
    terms = (
        Term("interface", interface, at_points(points, count=ON_CURVE), weight, reported=1.0),
        Term(curvature.name, curvature, on_surface(ON_SURFACE)),
        Term("eikonal", eikonal, in_box(IN_BOX), fading(1.0, HOLD, FACTOR)),
    )
    return ShapeProblem(name, terms, box or box_around(points), start or plane_through(points))


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
