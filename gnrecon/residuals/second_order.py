"""Residuals of curvature, linearised:  dr = by_gradient . dg + by_hessian : dH  with g = grad f and H = Hess f.

The level set of f through a point has the unit normal n = g / |g| and, with P = I - n n^T, the shape operator
S = P H P / |g|, whose eigenvalues off n are the principal curvatures k1 and k2, positive on a sphere where f is
negative inside. Hence

    mean      k1 + k2       =  div n  =  (tr H - n . H n) / |g|
    Gauss     k1 k2         =  g . adj(H) g / |g|^4
    strain    k1^2 + k2^2   =  |S|^2

The strain's own root has no derivative where both curvatures vanish, and k1 and k2 have none where they agree. The
entries of S in a tangent frame, S_11, sqrt(2) S_12, S_22, are smooth everywhere and their squares sum to the strain. A
frame that turns along with n only as far as n itself turns has  d(t_i . S t_j) = t_i . dS t_j, so that it counts as
fixed here.

Sources: Goldman, Curvature formulas for implicit curves and surfaces (2005); King et al., Gauss-Newton natural gradient
descent for shape learning, its table of constraints, whose mean curvature is div n as well.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from gnrecon.residuals.first_order import Linearised

SHORTEST = 1e-12
"""Least |grad f| that is divided by: a critical point of f has finite curvatures, though no meaningful ones."""


@dataclass(frozen=True)
class SecondOrder:
    """A residual that needs second derivatives.

    Parameters
    ----------
    name : str
    linearise : takes values (N,), gradients (N, 3), Hessians (N, 3, 3) and targets or None
    tangential : whether n . H n is not looked at, and only tangential parts of H have a derivative, as with all
        curvatures of a level set; the second derivative across it then need not be known
    """

    name: str
    linearise: Callable[[Tensor, Tensor, Tensor, Tensor | None], Linearised]
    tangential: bool = False

    def __call__(self, value: Tensor, gradient: Tensor, hessian: Tensor, target: Tensor | None = None) -> Linearised:
        """Return the residuals with their derivatives."""
        return self.linearise(value, gradient, hessian, target)


def _mean(value: Tensor, gradient: Tensor, hessian: Tensor, target: Tensor | None) -> Linearised:
    """r = div n less the target, by default zero."""
    del value
    length, n = _unit(gradient)
    bend = _apply(hessian, n)
    tangent = _identity(gradient) - n[:, :, None] * n[:, None, :]
    mean = (_trace(hessian) - (n * bend).sum(1)) / length
    along = bend - (n * bend).sum(1, keepdim=True) * n
    by_gradient = -(2 * along / length[:, None] + mean[:, None] * n) / length[:, None]
    residual = mean if target is None else mean - target
    return Linearised(
        residual[:, None], None, by_gradient[:, None, :], (tangent / length[:, None, None])[:, None, :, :]
    )


def _gauss(value: Tensor, gradient: Tensor, hessian: Tensor, target: Tensor | None) -> Linearised:
    """r = k1 k2 less the target, by default zero."""
    del value
    length, n = _unit(gradient)
    bend, trace = _apply(hessian, n), _trace(hessian)
    minors = (trace.square() - hessian.square().sum((1, 2))) / 2
    # adj(H) = H^2 - tr(H) H + minors I
    adjugate = _apply(hessian, bend) - trace[:, None] * bend + minors[:, None] * n
    square = length.square()
    gauss = (n * adjugate).sum(1) / square
    by_gradient = (2 * adjugate / square[:, None] - 4 * gauss[:, None] * n) / length[:, None]
    by_hessian = (
        bend[:, :, None] * n[:, None, :]
        + n[:, :, None] * bend[:, None, :]
        - (n * bend).sum(1)[:, None, None] * _identity(gradient)
        - trace[:, None, None] * n[:, :, None] * n[:, None, :]
        + trace[:, None, None] * _identity(gradient)
        - hessian
    ) / square[:, None, None]
    residual = gauss if target is None else gauss - target
    return Linearised(residual[:, None], None, by_gradient[:, None, :], by_hessian[:, None, :, :])


def _strain(value: Tensor, gradient: Tensor, hessian: Tensor, target: Tensor | None) -> Linearised:
    """Three residuals, S_11, sqrt(2) S_12 and S_22 in a tangent frame, whose squares sum to k1^2 + k2^2."""
    del value, target
    length, n = _unit(gradient)
    frame = tangent_frame(n)
    shape = frame.mT @ hessian @ frame / length[:, None, None]
    # h . t_i, the part of dS that comes from the normal's turning: -(t_i . dn)(h . t_j) - (h . t_i)(t_j . dn).
    twist = (frame.mT @ _apply(hessian, n)[:, :, None])[:, :, 0] / length.square()[:, None]
    entries, by_gradient, by_hessian = [], [], []
    for i, j, factor in ((0, 0, 1.0), (0, 1, math.sqrt(2.0)), (1, 1, 1.0)):
        one, other = frame[:, :, i], frame[:, :, j]
        turned = one * twist[:, j, None] + other * twist[:, i, None] + n * (shape[:, i, j] / length)[:, None]
        pair = one[:, :, None] * other[:, None, :]
        entries.append(factor * shape[:, i, j])
        by_gradient.append(-factor * turned)
        by_hessian.append(factor / 2 * (pair + pair.mT) / length[:, None, None])
    return Linearised(torch.stack(entries, 1), None, torch.stack(by_gradient, 1), torch.stack(by_hessian, 1))


mean_curvature = SecondOrder("mean curvature", _mean, tangential=True)
"""The surface is minimal, or k1 + k2 is the target, of shape (N,)."""

gauss_curvature = SecondOrder("Gauss curvature", _gauss, tangential=True)
"""The surface is developable, or k1 k2 is the target, of shape (N,)."""

surface_strain = SecondOrder("surface strain", _strain, tangential=True)
"""The surface is as flat as can be: k1^2 + k2^2 as the sum of three squares."""


def clipped_strain(maximum: float) -> SecondOrder:
    """Return the strain that counts as `maximum`, in squared inverse lengths, wherever it is more.

    There the loss is constant, so that edges and creases neither dominate it nor are pulled at. Targets, of shape (N,),
    are maxima of their own.
    """

    def linearise(value: Tensor, gradient: Tensor, hessian: Tensor, target: Tensor | None) -> Linearised:
        linear = _strain(value, gradient, hessian, None)
        most = torch.full_like(value, maximum) if target is None else target
        beyond = linear.residual.square().sum(1) > most
        constant = torch.stack([most.sqrt(), torch.zeros_like(most), torch.zeros_like(most)], 1)
        return Linearised(
            torch.where(beyond[:, None], constant, linear.residual),
            None,
            torch.where(beyond[:, None, None], 0.0, _known(linear.by_gradient)),
            torch.where(beyond[:, None, None, None], 0.0, _known(linear.by_hessian)),
        )

    return SecondOrder(f"surface strain, at most {maximum:g}", linearise, tangential=True)


def tangents(gradient: Tensor) -> Tensor:
    """Return two orthonormal tangents, of shape (2, N, 3), of level sets, by their gradients, of shape (N, 3)."""
    return tangent_frame(_unit(gradient)[1]).permute(2, 0, 1)


def tangent_frame(normals: Tensor) -> Tensor:
    """Return two orthonormal tangents as columns, of shape (N, 3, 2), of unit normals, of shape (N, 3).

    Source: Duff et al., Building an orthonormal basis, revisited (2017).
    """
    x, y, z = normals.unbind(1)
    sign = torch.where(z < 0, -1.0, 1.0).to(normals)
    a = -1.0 / (sign + z)
    b = x * y * a
    first = torch.stack([1 + sign * x * x * a, sign * b, -sign * x], 1)
    second = torch.stack([b, sign + y * y * a, -y], 1)
    return torch.stack([first, second], 2)


def _unit(gradient: Tensor) -> tuple[Tensor, Tensor]:
    """Return |g|, of shape (N,), bounded below, and g / |g|, of shape (N, 3)."""
    length: Tensor = torch.linalg.vector_norm(gradient, dim=1)
    # A gradient of zero has no direction; any will do.
    upright = torch.zeros_like(gradient)
    upright[:, 2] = 1.0
    n = torch.where(length[:, None] > SHORTEST, gradient / length.clamp_min(SHORTEST)[:, None], upright)
    return length.clamp_min(SHORTEST), n


def _apply(matrices: Tensor, vectors: Tensor) -> Tensor:
    return (matrices @ vectors[:, :, None])[:, :, 0]


def _trace(matrices: Tensor) -> Tensor:
    return matrices.diagonal(dim1=1, dim2=2).sum(1)


def _identity(like: Tensor) -> Tensor:
    return torch.eye(3, dtype=like.dtype, device=like.device)


def _known(part: Tensor | None) -> Tensor:
    assert part is not None, "strain depends on the gradient and on second derivatives"
    return part
