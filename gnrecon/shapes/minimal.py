"""Plateau's problem: the minimal surface in a given curve, k1 + k2 = 0.

The paper's two have known solutions: the catenoid between two circles of radius cosh 1 at z = -1 and 1, and Enneper's
surface within its boundary curve of parameter radius 0.9. Its terms are the interface, f = 0 on the curves, and the
mean curvature on the surface within the box, both of weight one (`shapes.curves`).

Once the surface has its shape, its distance from the known one is about the residual on the curves. So the interface's
weight rises after forty steps, to fifty; the loss that is reported has the paper's weights.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from gnrecon import level_set as levelset
from gnrecon.geometry.signed_distance import Box
from gnrecon.residuals import mean_curvature
from gnrecon.shapes.curves import through_curves
from gnrecon.shapes.problem import ShapeProblem, Start, circle, cube, z_cylinder, z_plane
from gnrecon.shapes.term import rising

RISE = 40, 1.1, 50.0
"""Steps for which the interface keeps the weight one, its factor from step to step after them, and its most."""


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
    return through_curves(name, curve, mean_curvature, start, box, rising(1.0, *RISE))


def catenoid() -> ShapeProblem:
    """Return the paper's catenoid problem; the part between the circles is meshed."""
    points = np.concatenate([circle(np.cosh(1.0), height) for height in (-1.0, 1.0)])
    problem = minimal_surface(points, start=z_cylinder(), box=cube(2.0), name="catenoid")
    between = Box(np.array([-2.0, -2.0, -1.0]), np.array([2.0, 2.0, 1.0]))
    return replace(problem, known=levelset.catenoid(), shown=between)


def enneper(radius: float = 0.9) -> ShapeProblem:
    """Return the paper's problem of Enneper's surface; all that is in the box is meshed."""
    t = 2 * np.pi * np.arange(1000) / 1000
    x = radius * np.cos(t) - radius**3 * np.cos(3 * t) / 3
    y = radius * np.sin(t) + radius**3 * np.sin(3 * t) / 3
    curve = np.stack([x, y, radius**2 * np.cos(2 * t)], axis=1)
    problem = minimal_surface(curve, start=z_plane, box=cube(1.0), name="enneper")
    return replace(problem, known=levelset.enneper(radius))
