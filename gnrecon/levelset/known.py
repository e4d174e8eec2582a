"""The surfaces that the paper's problems have for their solutions, as far as they are known in closed form.

The catenoid (cosh z cos t, cosh z sin t, z), |z| <= 1, is the minimal surface between its two circles of radius
cosh 1. Enneper's surface

    (u - u^3/3 + u v^2,  v - v^3/3 + u^2 v,  u^2 - v^2),   u^2 + v^2 <= 0.9^2,

is the minimal surface within its boundary curve. The mantle of a cone between circles of radius 1 at z = 0 and 0.4 at
z = 1 is a developable surface between them.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from gnrecon.levelset.parametric import ParametricSurface

ENNEPER_RADIUS = 0.9
CONE_RADII = (1.0, 0.4)

Profile = Callable[[Tensor], Tensor]


def catenoid() -> ParametricSurface:
    """Return the catenoid between z = -1 and 1, with parameters (t, z)."""
    return _revolved(torch.cosh, torch.sinh, -1.0, 1.0)


def cone() -> ParametricSurface:
    """Return the mantle of the truncated cone between z = 0 and 1, with parameters (t, z)."""
    base, top = CONE_RADII
    return _revolved(lambda z: base + (top - base) * z, lambda z: torch.full_like(z, top - base), 0.0, 1.0)


def enneper(radius: float = ENNEPER_RADIUS) -> ParametricSurface:
    """Return Enneper's surface over the disk of a radius, below sqrt(3), where it does not meet itself."""

    def position(p: Tensor) -> Tensor:
        u, v = p.unbind(1)
        return torch.stack([u - u**3 / 3 + u * v**2, v - v**3 / 3 + u**2 * v, u**2 - v**2], dim=1)

    def tangents(p: Tensor) -> Tensor:
        u, v = p.unbind(1)
        along_u = torch.stack([1 - u**2 + v**2, 2 * u * v, 2 * u], dim=1)
        along_v = torch.stack([2 * u * v, 1 - v**2 + u**2, -2 * v], dim=1)
        return torch.stack([along_u, along_v], dim=2)

    def parameters(square: Tensor) -> Tensor:
        # Equal areas of the disk: the square root of the first coordinate as radius.
        reach, angle = radius * square[:, 0].sqrt(), 2 * math.pi * square[:, 1]
        return torch.stack([reach * angle.cos(), reach * angle.sin()], dim=1)

    return ParametricSurface(position, tangents, parameters, lambda p: p.square().sum(1) <= radius**2)


def _revolved(radius: Profile, slope: Profile, low: float, high: float) -> ParametricSurface:
    """Return the surface of revolution about z of a radius as a function of z, with the parameters (t, z)."""

    def position(p: Tensor) -> Tensor:
        t, z = p.unbind(1)
        return torch.stack([radius(z) * t.cos(), radius(z) * t.sin(), z], dim=1)

    def tangents(p: Tensor) -> Tensor:
        t, z = p.unbind(1)
        around = torch.stack([-radius(z) * t.sin(), radius(z) * t.cos(), torch.zeros_like(z)], dim=1)
        along = torch.stack([slope(z) * t.cos(), slope(z) * t.sin(), torch.ones_like(z)], dim=1)
        return torch.stack([around, along], dim=2)

    def parameters(square: Tensor) -> Tensor:
        return torch.stack([2 * math.pi * square[:, 1], low + (high - low) * square[:, 0]], dim=1)

    return ParametricSurface(position, tangents, parameters, lambda p: (p[:, 1] >= low) & (p[:, 1] <= high))
