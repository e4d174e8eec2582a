"""The derivative of a residual due to the motion of the surface: the transport terms that the paper neglects.

A loss over a moving level set G = {f = 0}, of unit normal n = grad f / |grad f| and k1 + k2 = div n,

    L = 1/2 integral over G of r^2,

changes with a parameter for three reasons: r changes at fixed points, the surface moves to where r is different, and
its area changes. The surface moves along n by v = -df / |grad f|, so that

    dL = integral over G of  r (dr + v d_n r)  +  1/2 r^2 (k1 + k2) v,          d_n r = n . grad r.

The paper's equation for the gradient of a moving surface's loss has the same three terms. Its experiments resample the
surface at every step and keep only the first term. The paper drops the second because it uses the surface gradient
there, to which a motion along n is orthogonal. That is right for an r that is constant along n, but r as a function of
f and its derivatives is not.

All three terms together have the form of the first, with dr replaced by

    dr - (d_n r + r (k1 + k2) / 2) df / |grad f|

J^T r is then the gradient of L, and J^T J the Gauss-Newton matrix of r sqrt(dA) moving with the surface. No rows are
added: only the coefficient of df changes.

Source: the transport theorem for surfaces, as in Delhaye (1974) and Cermelli, Fried and Gurtin, Transport relations
for surface integrals arising in the formulation of balance laws for evolving fluid interfaces (2005).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from gnrecon.residuals.constraints import Linearised


def transported(
    linear: Linearised,
    gradient: Tensor,
    curvature: Tensor,
    normal_derivative: Tensor | None = None,
) -> Linearised:
    """Return the linearisation of a residual on a level set, including the motion of the level set.

    Parameters
    ----------
    linear : residuals r, of shape (N, m), at points of the level set
    gradient : grad f there, of shape (N, 3)
    curvature : k1 + k2 = div n, of shape (N,), positive on a sphere that is negative inside
    normal_derivative : d_n r, of shape (N, m); without it only the change of area is added, the paper's third term

    Nothing is added where grad f vanishes, because there is no surface to move.
    """
    length = torch.linalg.vector_norm(gradient, dim=1)
    rate = linear.residual * (curvature / 2)[:, None]
    if normal_derivative is not None:
        rate = rate + normal_derivative
    defined = length > torch.finfo(length.dtype).tiny
    inverse = torch.where(defined, 1 / torch.where(defined, length, 1.0), 0.0)
    moved = -rate * inverse[:, None]
    return replace(linear, by_value=moved if linear.by_value is None else linear.by_value + moved)


def derivative_along(residual: Callable[[Tensor], Tensor], points: Tensor, normals: Tensor, step: float) -> Tensor:
    """Return the derivative of a function of space along unit normals, both of shape (N, 3), of shape (N, m).

    By central differences of fourth order: residuals of curvature contain second derivatives of f, and third ones in
    closed form would cost more than four evaluations.

    Parameters
    ----------
    residual : takes points, of shape (N, 3), to r, of shape (N, m)
    step : in the coordinates' unit; 1e-3 of the lengths over which r varies is about right
    """
    near = residual(points + step * normals) - residual(points - step * normals)
    far = residual(points + 2 * step * normals) - residual(points - 2 * step * normals)
    return (8 * near - far) / (12 * step)
