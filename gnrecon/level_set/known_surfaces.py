"""The solutions of the paper's problems that are known in closed form, and the Chamfer divergence from them.

The catenoid (cosh z cos t, cosh z sin t, z), |z| <= 1, is the minimal surface between its two circles of radius
cosh 1. Enneper's surface

    (u - u^3/3 + u v^2,  v - v^3/3 + u^2 v,  u^2 - v^2),   u^2 + v^2 <= 0.9^2,

is the minimal surface within its boundary curve. The mantle of a cone between circles of radius 1 at z = 0 and 0.4 at
z = 1 is a developable surface between them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from gnrecon.level_set.level_set import LevelSet
from gnrecon.level_set.newton_projection import nearest
from gnrecon.level_set.sampling import SurfaceSample, sample_surface

Profile = Callable[[Tensor], Tensor]


def catenoid() -> ParametricSurface:
    """Return the catenoid between z = -1 and 1, with parameters (t, z)."""
    return _revolved(torch.cosh, torch.sinh, -1.0, 1.0)


def cone(base: float = 1.0, top: float = 0.4) -> ParametricSurface:
    """Return the mantle of a truncated cone with the radii `base` at z = 0 and `top` at z = 1; parameters (t, z)."""
    return _revolved(lambda z: base + (top - base) * z, lambda z: torch.full_like(z, top - base), 0.0, 1.0)


def enneper(radius: float = 0.9) -> ParametricSurface:
    """Return Enneper's surface over a disk; below a radius of sqrt(3) it does not intersect itself."""

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


class KnownSurface(Protocol):
    """A known surface, or a patch of one, to compare a level set with."""

    def sample(self, count: int) -> tuple[Tensor, Tensor]:
        """Return about `count` points, of shape (M, 3), and the share of the area that each represents, (M,)."""
        ...

    def nearest(self, queries: Tensor) -> tuple[Tensor, Tensor]:
        """Return the nearest points, of shape (N, 3), to queries, (N, 3), and whether they are in the patch, (N,)."""
        ...


# Parametric surfaces: sampling by area, and nearest points, found in the parameters.
#
# The nearest point X(u) to q minimises |X(u) - q|^2 / 2 over the parameters u. With the tangents T = dX/du, of shape
# (3, 2), Gauss-Newton steps solve
#
#     (T^T T + m tr(T^T T) I) du = T^T (q - X),
#
# with a damping m for each point that falls while the distance does and rises when it does not (Levenberg-Marquardt).
# They start at the nearest of many sampled points, so that they find the global minimum. For a query at distance d they
# contract by d x curvature, which is nearly zero for surfaces that agree.


@dataclass(frozen=True)
class ParametricSurface:
    """A patch of a smooth surface.

    Parameters
    ----------
    position : X of parameters of shape (N, 2), of shape (N, 3); also somewhat beyond the patch
    tangents : dX/du, of shape (N, 3, 2)
    parameters : maps the unit square, (N, 2), to the patch's parameters, (N, 2), with a constant factor of area
    inside : whether parameters belong to the patch, of shape (N,)
    """

    position: Callable[[Tensor], Tensor]
    tangents: Callable[[Tensor], Tensor]
    parameters: Callable[[Tensor], Tensor]
    inside: Callable[[Tensor], Tensor]

    def sample(self, count: int) -> tuple[Tensor, Tensor]:
        """Return points of the patch, of shape (count, 3), and the share of the area of each, of shape (count,)."""
        parameters = self._lattice(count)
        t = self.tangents(parameters)
        areas = torch.linalg.vector_norm(torch.linalg.cross(t[:, :, 0], t[:, :, 1]), dim=1)
        return self.position(parameters), areas / areas.sum()

    def nearest(self, queries: Tensor, *, iterations: int = 60) -> tuple[Tensor, Tensor]:
        """Return the nearest points, of shape (N, 3), of the surface to queries, (N, 3), and whether in the patch.

        Parameters
        ----------
        iterations : Levenberg-Marquardt steps
        """
        u = self._starts(queries)
        position = self.position(u)
        square = (position - queries).square().sum(1)
        damping = torch.full_like(square, 1e-3)
        for _ in range(iterations):
            tried = u + self._step(u, queries - position, damping)
            new_position = self.position(tried)
            new_square = (new_position - queries).square().sum(1)
            better = new_square < square
            damping = torch.where(better, damping / 10, damping * 4).clamp(1e-12, 1e6)
            u = torch.where(better[:, None], tried, u)
            position = torch.where(better[:, None], new_position, position)
            square = torch.where(better, new_square, square)
        return position, self.inside(u)

    def _step(self, u: Tensor, toward: Tensor, damping: Tensor) -> Tensor:
        """Return the damped Gauss-Newton step of each point, of shape (N, 2)."""
        t = self.tangents(u)
        metric = t.mT @ t
        scale = metric.diagonal(dim1=1, dim2=2).sum(1).clamp_min(torch.finfo(t.dtype).tiny)
        damped = metric + (damping * scale)[:, None, None] * torch.eye(2, dtype=t.dtype)
        step: Tensor = torch.linalg.solve(damped, t.mT @ toward[:, :, None])[:, :, 0]
        return step

    def _starts(self, queries: Tensor, samples: int = 20_000) -> Tensor:
        """Return the parameters, of shape (N, 2), of the nearest of `samples` points of the patch."""
        from scipy.spatial import cKDTree

        parameters = self._lattice(samples)
        nearest = cKDTree(self.position(parameters).numpy()).query(queries.numpy())[1]
        return parameters[torch.as_tensor(nearest)]

    def _lattice(self, count: int) -> Tensor:
        """Return parameters, of shape (count, 2), evenly distributed over the patch by the golden-ratio lattice."""
        golden = (5**0.5 - 1) / 2
        number = np.arange(count)
        square = np.stack([(number + 0.5) / count, (number * golden) % 1.0], axis=1)
        return self.parameters(torch.as_tensor(square))


# The paper's Chamfer divergence between a level set and a known surface, by projection.
#
# The paper defines (its appendix on the Chamfer divergence)
#
#     CD_1(P, Q)^2 = (1 / |Q|) sum over x in Q of min over y in P of |x - y|^2
#
# and finds the nearest y by projecting x onto P, not among samples of P, whose spacing would dominate the result. Here
# P is the level set and Q the known surface, sampled with weights a_i in proportion to area:
#
#     CD_1 = sqrt(sum_i a_i |x_i - y(x_i)|^2),      y(x) the nearest point of the level set.
#
# Two starts are tried for each nearest point (`newton_projection.nearest`): x itself, which is good where the surfaces
# agree, and the nearest of many points of the level set, which is good where they do not. If neither converges, the
# distance to the latter is used.
#
# The other direction, from the level set to the known surface (`to_known`), also detects sheets of the level set that
# the known surface does not have. A level set continues beyond the border of a patch, so only points whose foot is
# inside the patch count.


@dataclass(frozen=True)
class ChamferDivergence:
    """Root mean square distances, in the unit of the coordinates; infinite if the level set is empty.

    Parameters
    ----------
    from_known : CD_1, from points of the known surface to the level set, as the paper reports
    to_known : from points of the level set, whose foot is in the patch, to the known surface
    """

    from_known: float
    to_known: float


def chamfer_divergence(
    level_set: LevelSet,
    known: KnownSurface,
    rng: np.random.Generator,
    count: int = 4000,
    *,
    start_samples: int = 10_000,
) -> ChamferDivergence:
    """Measure the distance between a level set and a known surface within its box.

    Parameters
    ----------
    level_set : on the CPU
    rng : for the sample of the level set
    count : points of each surface from which the distance is measured
    start_samples : points of the level set among which the starts of projections are chosen
    """
    sample = sample_surface(level_set, max(start_samples, count), rng)
    if not len(sample):
        return ChamferDivergence(float("inf"), float("inf"))
    points, shares = known.sample(count)
    distances = distances_to(level_set, points, sample)
    return ChamferDivergence(float((shares * distances.square()).sum().sqrt()), _to_known(sample, known, count))


def distances_to(level_set: LevelSet, queries: Tensor, sample: SurfaceSample) -> Tensor:
    """Return the distances, of shape (N,), of queries, (N, 3), from the level set, with starts from `sample`."""
    from scipy.spatial import cKDTree

    distances, rows = cKDTree(sample.points.numpy()).query(queries.numpy())
    least = torch.as_tensor(distances)
    cap = level_set.diagonal / 20
    for starts in (sample.points[torch.as_tensor(rows)], queries):
        feet = nearest(level_set, queries, starts, cap)
        converged = feet.converged & level_set.contains(feet.points)
        found = torch.linalg.vector_norm(feet.points - queries, dim=1)
        least = torch.where(converged, torch.minimum(least, found), least)
    return least


def _to_known(sample: SurfaceSample, known: KnownSurface, count: int) -> float:
    # The sample is ordered along a space-filling curve, so every n-th point is an even sample too.
    points = sample.points[:: max(1, len(sample) // count)]
    feet, inside = known.nearest(points)
    squares = (feet - points).square().sum(1)[inside]
    return float(squares.mean().sqrt()) if len(squares) else float("inf")
