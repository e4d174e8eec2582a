"""Residuals by name: those of this library, and those of other packages.

Another package's entry point in the group ``gnrecon.residuals`` names a function of values, gradients and targets that
returns `Linearised`, or a `SecondOrder` residual. The result is checked at each call, because a derivative of the wrong
shape would otherwise fail far from its cause.
"""

from __future__ import annotations

from torch import Tensor

from gnrecon.residuals.constraints import (
    Linearised,
    Residual,
    SecondOrder,
    design_region,
    eikonal,
    gauss_curvature,
    interface,
    mean_curvature,
    normal_cosine,
    normal_projection,
    normal_vector,
    signed_distance,
    surface_strain,
)
from gnrecon.runtime.errors import FitError, UsageError
from gnrecon.runtime.plugins import Plugin, find, installed

RESIDUALS: dict[str, Residual | SecondOrder] = {
    "interface": interface,
    "design_region": design_region,
    "signed_distance": signed_distance,
    "normal_vector": normal_vector,
    "normal_projection": normal_projection,
    "normal_cosine": normal_cosine,
    "eikonal": eikonal,
    "mean_curvature": mean_curvature,
    "gauss_curvature": gauss_curvature,
    "surface_strain": surface_strain,
}


def named(name: str) -> Residual | SecondOrder:
    """Return the residual of a name, of this library or of another package.

    Raises
    ------
    UsageError
        When there is none of that name, several packages offer it, or it cannot be loaded.
    """
    if name in RESIDUALS:
        return RESIDUALS[name]
    plugin = find("residual", name)
    if plugin is None:
        known = ", ".join([*RESIDUALS, *(one.entry.name for one in installed("residual"))])
        raise UsageError(f"There is no residual {name!r}; there are {known}.")
    found = plugin.load()
    return _second(plugin, found) if isinstance(found, SecondOrder) else _first(plugin, found)


def _first(plugin: Plugin, residual: Residual) -> Residual:
    def checked(value: Tensor, gradient: Tensor, target: Tensor | None) -> Linearised:
        with plugin.guarded(FitError):
            return _require(plugin, residual(value, gradient, target), len(value))

    return checked


def _second(plugin: Plugin, residual: SecondOrder) -> SecondOrder:
    def checked(value: Tensor, gradient: Tensor, hessian: Tensor, target: Tensor | None) -> Linearised:
        with plugin.guarded(FitError):
            return _require(plugin, residual(value, gradient, hessian, target), len(value))

    return SecondOrder(residual.name, checked, residual.tangential)


def _require(plugin: Plugin, found: object, count: int) -> Linearised:
    """Check that the result is linearised residuals of `count` points, and return it.

    Raises
    ------
    FitError
        With the first problem found.
    """
    if not isinstance(found, Linearised):
        raise FitError(f"{plugin.subject} returned {type(found).__name__}, but must return Linearised.")
    rows = tuple(found.residual.shape)
    if len(rows) != 2 or rows[0] != count:
        raise FitError(f"{plugin.subject} returned residuals of shape {rows}, but ({count}, m) was expected.")
    shapes = {"by_value": rows, "by_gradient": (*rows, 3), "by_hessian": (*rows, 3, 3)}
    for name, expected in shapes.items():
        part = getattr(found, name)
        if part is not None and tuple(part.shape) != expected:
            raise FitError(
                f"{plugin.subject} returned {name} of shape {tuple(part.shape)}, but {expected} was expected."
            )
    return found
