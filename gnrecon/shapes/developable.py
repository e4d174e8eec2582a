"""Developable surfaces, k1 k2 = 0: those that unroll into the plane without stretching.

The paper's is the mantle of a truncated cone between a circle of radius 1 at z = 0 and one of radius 0.4 at z = 1. Its
terms are those of `shapes.minimal` with the Gauss curvature in the place of the mean one. Where a surface is flat in
every direction the Gauss curvature vanishes to second order and tells a step nothing, so that the start matters more:
the problem has other solutions, such as two planes.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from gnrecon import level_set as levelset
from gnrecon.geometry.signed_distance import Box
from gnrecon.residuals import gauss_curvature
from gnrecon.shapes.curves import through_curves
from gnrecon.shapes.problem import ShapeProblem, Start, circle, cube, z_cylinder


def developable_surface(
    curve: npt.ArrayLike, *, start: Start | None = None, box: Box | None = None, name: str = "developable surface"
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
    return through_curves(name, curve, gauss_curvature, start, box)


def cone() -> ShapeProblem:
    """Return the paper's problem of the cone; the mantle between the circles is meshed."""
    curves = np.concatenate([circle(1.0, 0.0), circle(0.4, 1.0)])
    problem = developable_surface(curves, start=z_cylinder(), box=cube(1.0), name="cone")
    mantle = Box(np.array([-1.0, -1.0, 0.0]), np.array([1.0, 1.0, 1.0]))
    return replace(problem, known=levelset.cone(), shown=mantle)
