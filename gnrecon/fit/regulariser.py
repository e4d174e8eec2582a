"""What a fit asks of its surface beside its data: to be smooth, minimal where there is no data, or developable.

    smooth   strain=W      W / 2 mean of k1^2 + k2^2 over the surface
    fill     minimal       W / 2 mean of (k1 + k2)^2, only where the surface is far from all points
    prior    developable   W / 2 mean of (k1 k2)^2, where it is no crease

each beside half the mean square distance of the points from the surface. All lengths are in radii of the scan. A bump
of wavenumber k costs f^2 by the data and W k^4 f^2 by the strain, so that bumps of the wavelength 2 pi W^(1/4) are
halved, and shorter ones all but vanish. A closed surface cannot be developable everywhere: its Gauss curvature must add
up, and it does so in creases and corners. So the square of k1 k2 counts as Geman and McClure's robust r^2 / (1 + r^2),
r over `CREASE`, which pulls at creases no more.
Source: King et al., Gauss-Newton natural gradient descent for shape learning (its table of constraints); Geman and
McClure, Statistical methods for tomographic image reconstruction (1987).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from gnrecon.residuals import SecondOrder, gauss_curvature, mean_curvature, surface_strain
from gnrecon.runtime.errors import UsageError

FILL, DEVELOPABLE = 1e-2, 1e-3
"""Weights of `minimal` and of `developable` without one of their own."""

CREASE = 8.0
"""Gauss curvature, per squared radius, from which on a place counts as a crease."""


@dataclass(frozen=True)
class Regulariser:
    """One thing that is asked of the surface.

    Parameters
    ----------
    name : as it was asked for
    residual : of curvature, in radii
    weight : W
    holes : whether it is asked for only where the surface is far from all points
    crease : size of the residual from which on it hardly counts, or None
    """

    name: str
    residual: SecondOrder
    weight: float
    holes: bool = False
    crease: float | None = None


def regularisers(smooth: str | None, fill: str | None, prior: str | None) -> tuple[Regulariser, ...]:
    """Return what was asked for, each None or a text such as ``"strain=1e-4"``, ``"minimal"`` or ``"developable"``.

    Raises
    ------
    UsageError
        When a text asks for something else, or a weight is no positive number.
    """
    found = []
    if smooth is not None:
        found.append(Regulariser("strain", surface_strain, _weight("smooth", smooth, "strain", None)))
    if fill is not None:
        found.append(Regulariser("minimal", mean_curvature, _weight("fill", fill, "minimal", FILL), holes=True))
    if prior is not None:
        weight = _weight("prior", prior, "developable", DEVELOPABLE)
        found.append(Regulariser("developable", gauss_curvature, weight, crease=CREASE))
    return tuple(found)


def _weight(option: str, text: str, known: str, default: float | None) -> float:
    """Return the weight in ``known=weight``, or the default where it may be left out and is."""
    name, equals, number = text.partition("=")
    if name != known or (default is None and not equals):
        shape = f"{known}=WEIGHT" + ("" if default is None else f" or {known} alone")
        raise UsageError(f"The option {option} takes {shape}, such as {known}=1e-4, not {text!r}.")
    if default is not None and not equals:
        return default
    try:
        weight = float(number)
    except ValueError:
        weight = math.nan
    if not 0 < weight < math.inf:
        raise UsageError(f"The weight of {option} must be a positive number, as in {known}=1e-4, not {number!r}.")
    return weight
