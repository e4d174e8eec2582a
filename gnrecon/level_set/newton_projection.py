"""Orthogonal Newton projection: along the gradient onto the level set, and to its nearest point.

The first-order expansion of f along its gradient g vanishes after the step

    x  <-  x - f g / |g|^2,

which the paper uses to refine surface samples (its appendix on surface sampling, after Chopp, Some improvements of
the fast marching method, 2001). It converges quadratically near the surface. Far from it, or where g is small, the
length of the step is capped; at a critical point, where there is no direction, the point stays and is reported as not
converged.

The point of the level set that is *nearest* to a given q also satisfies that q - x is parallel to g there. Each step
takes for x the foot of q on the tangent plane of f's level at x,

    x  <-  q - (f + g . (q - x)) g / |g|^2,

whose fixed points are those feet. It contracts by (distance of q) x (curvature), so it works for points near the
surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gnrecon.level_set.level_set import LevelSet
from gnrecon.level_set.level_set_parameters import LevelSetParameters


@dataclass(frozen=True)
class Projection:
    """Points after a projection.

    Parameters
    ----------
    points : of shape (N, 3)
    gradients : grad f there, of shape (N, 3)
    distances : f / |grad f| there, of shape (N,): the remaining signed distance, to first order
    converged : whether it is zero up to the tolerance, of shape (N,)
    """

    points: Tensor
    gradients: Tensor
    distances: Tensor
    converged: Tensor


def newton_step(
    level_set: LevelSet,
    points: Tensor,
    cap: float,
    *,
    tolerance_diagonals: float = LevelSetParameters.tolerance_diagonals,
) -> Projection:
    """Return points, of shape (N, 3), after one step of at most `cap`; gradients and distances are those before it."""
    value, gradient = level_set.values_and_gradients(points)
    distance, normal = _measured(value, gradient)
    moved = points - distance.clamp(-cap, cap)[:, None] * normal
    return Projection(moved, gradient, distance, _is_on(distance, level_set, tolerance_diagonals))


def project(
    level_set: LevelSet,
    points: Tensor,
    cap: float,
    iterations: int = 30,
    *,
    parameters: LevelSetParameters = LevelSetParameters(),
) -> Projection:
    """Move points, of shape (N, 3), along the gradient onto the level set, each step by at most `cap`.

    Points that have not arrived after `iterations` steps, or that met a critical point, are not `converged`.
    """
    exact, rounding = parameters.tolerance_diagonals, parameters.rounding_tolerances * parameters.tolerance_diagonals
    points = points.clone()
    value, gradient = level_set.values_and_gradients(points)
    distance = _measured(value, gradient)[0]
    for number in range(iterations):
        # After the quadratic steps, further steps would only change rounding errors.
        tolerance = exact if number < parameters.quadratic_steps else rounding
        active = (~_is_on(distance, level_set, tolerance)).nonzero()[:, 0]
        if not len(active):
            break
        before, normal = _measured(value[active], gradient[active])
        points[active] -= before.clamp(-cap, cap)[:, None] * normal
        value[active], gradient[active] = level_set.values_and_gradients(points[active])
        distance[active] = _measured(value[active], gradient[active])[0]
    return Projection(points, gradient, distance, _is_on(distance, level_set, rounding))


def nearest(
    level_set: LevelSet,
    queries: Tensor,
    starts: Tensor,
    cap: float,
    iterations: int = 50,
    *,
    tolerance_diagonals: float = LevelSetParameters.tolerance_diagonals,
    settled_diagonals: float = 1e-9,
) -> Projection:
    """Find the feet of `queries`, of shape (N, 3), on the level set near `starts`, of the same shape.

    A foot is `converged` if it lies on the level set and its last step was at most `settled_diagonals` of the box's
    diagonal. It is then a point of the level set whose gradient points to the query, and the nearest one if the start
    was near it.
    """
    points = project(level_set, starts, cap).points
    moved = torch.full_like(points[:, 0], torch.inf)
    for _ in range(iterations):
        active = (moved > tolerance_diagonals * level_set.diagonal).nonzero()[:, 0]
        if not len(active):
            break
        step = _foot_step(level_set, queries[active], points[active], cap)
        points[active] += step
        moved[active] = torch.linalg.vector_norm(step, dim=1)
    # The remaining value of f is too small to change which point is nearest.
    on = project(level_set, points, cap)
    settled = moved <= settled_diagonals * level_set.diagonal
    return Projection(on.points, on.gradients, on.distances, on.converged & settled)


def _foot_step(level_set: LevelSet, queries: Tensor, points: Tensor, cap: float) -> Tensor:
    """Return the step from x to the foot of q on the tangent plane at x, at most `cap` long, of shape (N, 3)."""
    value, gradient = level_set.values_and_gradients(points)
    distance, normal = _measured(value, gradient)
    toward = queries - points
    step = toward - ((normal * toward).sum(1) + distance)[:, None] * normal
    length = torch.linalg.vector_norm(step, dim=1, keepdim=True)
    capped: Tensor = torch.where(distance[:, None].isfinite(), step, 0.0) * (cap / length.clamp_min(cap))
    return capped


def _measured(value: Tensor, gradient: Tensor) -> tuple[Tensor, Tensor]:
    """Return f / |g|, of shape (N,), infinite where g vanishes, and g / |g|, of shape (N, 3), zero there."""
    length = torch.linalg.vector_norm(gradient, dim=1)
    # Both lengths are checked, because the inverse of a subnormal length would overflow.
    defined = (length > torch.finfo(length.dtype).tiny) & value.isfinite() & length.isfinite()
    safe = torch.where(defined, length, 1.0)
    normal = torch.where(defined[:, None], gradient / safe[:, None], 0.0)
    return torch.where(defined, value / safe, torch.inf), normal


def _is_on(distance: Tensor, level_set: LevelSet, tolerance: float) -> Tensor:
    return distance.abs() <= tolerance * level_set.diagonal
