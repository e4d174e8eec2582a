"""From the critical nodes of a grid to the critical points of the field itself.

A minimum or a pass among nodes lies within about a cell of one of f, where grad f = 0 and the Hessian has no negative
eigenvalue or one. Newton's method finds it,

    x  <-  x - H^-1 grad f,

with H by central differences of the gradient, for there are few such points. Steps are capped, and a point is moved
only if the way ends near its node, at a critical point of the right kind. Others stay at their nodes: a pass at the
border of a region is none of f's, and where f is flat no point is better than another.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gnrecon.levelset.level_set import LevelSet

_ITERATIONS = 12
_REACH = 2.0
_SMALL = 1e-6
_DIGITS = 10


def refined(level_set: LevelSet, nodes: Tensor, spacing: float, negative: int) -> Tensor:
    """Return the critical points of f, of shape (K, 3), near nodes, (K, 3), of a grid; or the nodes where none is.

    Parameters
    ----------
    spacing : of the grid; a critical point is looked for within twice as much
    negative : of the Hessian's eigenvalues: 0 at a minimum, 1 at a pass
    """
    if not len(nodes):
        return nodes
    points = nodes.clone()
    for _ in range(_ITERATIONS):
        gradient, hessian = _derivatives(level_set, points, spacing)
        step = -torch.linalg.lstsq(hessian, gradient[:, :, None]).solution[:, :, 0]
        length = torch.linalg.vector_norm(step, dim=1, keepdim=True)
        points = points + step.nan_to_num() * (spacing / 2 / length.clamp_min(spacing / 2))
    gradient, hessian = _derivatives(level_set, points, spacing)
    slope, before = (torch.linalg.vector_norm(g, dim=1) for g in (gradient, _gradient(level_set, nodes)))
    found = (
        (torch.linalg.vector_norm(points - nodes, dim=1) <= _REACH * spacing)
        & (slope <= _SMALL * before.clamp_min(torch.finfo(before.dtype).tiny))
        & ((torch.linalg.eigvalsh(hessian) < 0).sum(1) == negative)
    )
    # The last digits of the linear solves depend on where arrays lie in memory, and a run should not.
    return torch.where(found[:, None], points.round(decimals=_DIGITS), nodes)


def _derivatives(level_set: LevelSet, points: Tensor, spacing: float) -> tuple[Tensor, Tensor]:
    """Return grad f, of shape (K, 3), and Hess f, of shape (K, 3, 3)."""
    step = 1e-4 * spacing
    shifts = step * torch.eye(3, dtype=points.dtype, device=points.device)
    columns = [_gradient(level_set, points + s) - _gradient(level_set, points - s) for s in shifts]
    hessian = torch.stack(columns, dim=2) / (2 * step)
    return _gradient(level_set, points), ((hessian + hessian.mT) / 2).nan_to_num()


def _gradient(level_set: LevelSet, points: Tensor) -> Tensor:
    return level_set.values_and_gradients(points)[1].nan_to_num()
