"""Residuals of a field's value f and gradient g, linearised:  dr = by_value df + by_gradient . dg.

The names follow the paper's table of constraints; each function takes values of shape (N,), gradients of shape (N, 3)
and its targets, and returns m residuals for every point. It does not depend on networks or sampling.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.func import jacrev, vmap


@dataclass(frozen=True)
class Linearised:
    """Residuals r, of shape (N, m), and their derivatives; None means zero.

    The derivatives are those by f, (N, m), by grad f, (N, m, 3), and by Hess f, (N, m, 3, 3) and symmetric.
    """

    residual: Tensor
    by_value: Tensor | None
    by_gradient: Tensor | None
    by_hessian: Tensor | None = None

    def rate(self, value: Tensor, gradient: Tensor, hessian: Tensor | None) -> Tensor:
        """Return dr, of shape (N, m), for df, (N,), d(grad f), (N, 3), and, if it is known, d(Hess f), (N, 3, 3)."""
        rate = torch.zeros_like(self.residual)
        if self.by_value is not None:
            rate = rate + self.by_value * value[:, None]
        if self.by_gradient is not None:
            rate = rate + (self.by_gradient * gradient[:, None]).sum(2)
        if self.by_hessian is not None and hessian is not None:
            rate = rate + (self.by_hessian * hessian[:, None]).sum((2, 3))
        return rate


Residual = Callable[[Tensor, Tensor, Tensor | None], Linearised]


def interface(value: Tensor, gradient: Tensor, target: Tensor | None) -> Linearised:
    """The surface passes through the point: r = f (the paper's interface constraint)."""
    del gradient, target
    return Linearised(value[:, None], torch.ones_like(value)[:, None], None)


def design_region(value: Tensor, gradient: Tensor, target: Tensor | None) -> Linearised:
    """A point outside of the design region is not inside the shape: r = min(0, f).

    With least values as targets, of shape (N,), r = min(0, f - target).
    """
    del gradient
    return _below_zero(value if target is None else value - target, torch.ones_like(value))


def free_space(value: Tensor, gradient: Tensor, target: Tensor | None) -> Linearised:
    """The surface keeps a distance: f has its target's sign and at least its magnitude, r = min(0, sign(t) (f - t)).

    Targets t are of shape (N,). Only points where f is nearer to zero, or has the other sign, have a residual.
    """
    del gradient
    assert target is not None, "free space has targets"
    sign = torch.sign(target)
    return _below_zero(sign * (value - target), sign)


def signed_distance(value: Tensor, gradient: Tensor, target: Tensor | None) -> Linearised:
    """The value is known: r = f - target, targets of shape (N,).

    This is *supervised* in the paper's table. It is also *connectedness*, with critical points that join components and
    the values that would join them as targets.
    """
    del gradient
    assert target is not None, "signed distances are the targets of this residual"
    return Linearised((value - target)[:, None], torch.ones_like(value)[:, None], None)


def value_range(value: Tensor, gradient: Tensor, target: Tensor | None) -> Linearised:
    """The value is known to lie in a range: r = f - clip(f, least, most), zero within it.

    Targets are of shape (N, 2): the least and the most value.
    """
    del gradient
    assert target is not None, "the ends of the range are the targets of this residual"
    excess = value - value.clamp(target[:, 0], target[:, 1])
    return Linearised(excess[:, None], (excess != 0).to(value.dtype)[:, None], None)


def normal_vector(value: Tensor, gradient: Tensor, target: Tensor | None) -> Linearised:
    """The gradient is the unit normal n: r = grad f - n, three residuals a point, linear in f."""
    del value
    assert target is not None, "unit normals are the targets of this residual"
    axes = torch.eye(3, dtype=gradient.dtype, device=gradient.device).expand(len(gradient), 3, 3)
    return Linearised(gradient - target, None, axes)


def normal_projection(value: Tensor, gradient: Tensor, target: Tensor | None) -> Linearised:
    """The derivative along the unit normal n is one: r = n . grad f - 1.

    This is what the paper's experiments minimise; together with the eikonal constraint it is the prescribed normal of
    its table, whose own cosine form `normal_cosine` is flat to first order once the normals agree.
    """
    del value
    assert target is not None, "unit normals are the targets of this residual"
    return Linearised(((gradient * target).sum(1) - 1.0)[:, None], None, target[:, None, :])


def normal_cosine(value: Tensor, gradient: Tensor, target: Tensor | None) -> Linearised:
    """The gradient's direction is the unit normal n: r = n . grad f / |grad f| - 1 (the paper's table)."""
    del value
    assert target is not None, "unit normals are the targets of this residual"
    length = _length(gradient)
    unit = gradient / length
    cosine = (unit * target).sum(1, keepdim=True)
    return Linearised(cosine - 1.0, None, ((target - cosine * unit) / length)[:, None, :])


def eikonal(value: Tensor, gradient: Tensor, target: Tensor | None) -> Linearised:
    """The field is a distance: r = |grad f| - 1 (the paper's eikonal constraint)."""
    del value, target
    length = _length(gradient)
    return Linearised(length - 1.0, None, (gradient / length)[:, None, :])


def _length(gradient: Tensor) -> Tensor:
    """|grad f| of shape (N, 1), bounded below so that a critical point of f has a finite direction."""
    length: Tensor = torch.linalg.vector_norm(gradient, dim=1, keepdim=True)
    return length.clamp_min(1e-12)


def _below_zero(excess: Tensor, by_value: Tensor) -> Linearised:
    """Return r = min(0, excess), of shape (N, 1), from the excess and its derivative by f, of shape (N,) each."""
    below = excess < 0
    return Linearised(torch.where(below, excess, 0.0)[:, None], torch.where(below, by_value, 0.0)[:, None], None)


# Residuals of curvature, linearised: dr = by_gradient . dg + by_hessian : dH with g = grad f and H = Hess f.
#
# The level set of f through a point has the unit normal n = g / |g| and, with P = I - n n^T, the shape operator S = P H
# P / |g|, whose eigenvalues off n are the principal curvatures k1 and k2, positive on a sphere where f is negative
# inside. Hence
#
#     mean      k1 + k2       =  div n  =  (tr H - n . H n) / |g|
#     Gauss     k1 k2         =  g . adj(H) g / |g|^4
#     strain    k1^2 + k2^2   =  |S|^2
#
# The root of the strain has no derivative where both curvatures vanish, and k1 and k2 have none where they are equal.
# The entries of S in a tangent frame, S_11, sqrt(2) S_12, S_22, are smooth everywhere and their squares sum to the
# strain. For a frame that rotates only as n does, d(t_i . S t_j) = t_i . dS t_j, so it is treated as fixed.
#
# Sources: Goldman, Curvature formulas for implicit curves and surfaces (2005); King et al., Gauss-Newton natural
# gradient descent for shape learning, its table of constraints, whose mean curvature is div n as well.


@dataclass(frozen=True)
class SecondOrder:
    """A residual that needs second derivatives.

    Parameters
    ----------
    name : str
    linearise : takes values (N,), gradients (N, 3), Hessians (N, 3, 3) and targets or None
    tangential : whether it depends only on the tangential parts of H and not on n . H n, as all curvatures of a level
        set do; the second derivative across the level set is then not needed
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
    # h . t_i, the part of dS due to the rotation of the normal: -(t_i . dn)(h . t_j) - (h . t_i)(t_j . dn).
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
"""The surface bends as little as possible: k1^2 + k2^2 as the sum of three squares."""


def clipped_strain(maximum: float) -> SecondOrder:
    """Return the strain clipped to `maximum`, in squared inverse lengths.

    Where it is clipped the loss is constant, so that sharp edges neither dominate it nor are smoothed. Targets, of
    shape (N,), replace the maximum at each point.
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


def _unit(gradient: Tensor, *, shortest: float = 1e-12) -> tuple[Tensor, Tensor]:
    """Return |g|, of shape (N,), at least `shortest`, and g / |g|, of shape (N, 3).

    The bound gives critical points of f finite, though meaningless, curvatures.
    """
    length: Tensor = torch.linalg.vector_norm(gradient, dim=1)
    # A zero gradient has no direction; use any.
    upright = torch.zeros_like(gradient)
    upright[:, 2] = 1.0
    n = torch.where(length[:, None] > shortest, gradient / length.clamp_min(shortest)[:, None], upright)
    return length.clamp_min(shortest), n


def _apply(matrices: Tensor, vectors: Tensor) -> Tensor:
    return (matrices @ vectors[:, :, None])[:, :, 0]


def _trace(matrices: Tensor) -> Tensor:
    return matrices.diagonal(dim1=1, dim2=2).sum(1)


def _identity(like: Tensor) -> Tensor:
    return torch.eye(3, dtype=like.dtype, device=like.device)


def _known(part: Tensor | None) -> Tensor:
    assert part is not None, "strain depends on the gradient and on second derivatives"
    return part


Formula = Callable[[Tensor, Tensor, Tensor], Tensor]
"""From one point's value (), gradient (3,) and Hessian (3, 3) to m residuals, of shape (m,)."""


# A residual defined by a formula, for constraints that have no closed form here.
#
# The formula is differentiated automatically by the 13 numbers f, grad f and Hess f at each point and not through the
# network, which is cheap; the network's derivatives remain in closed form.


def from_formula(name: str, formula: Formula, tangential: bool = False) -> SecondOrder:
    """Return the residual of a formula.

    Parameters
    ----------
    name : its name in the history
    formula : from one point's value (), gradient (3,) and Hessian (3, 3) to residuals, of shape (m,), by torch
        functions that can be differentiated where they are evaluated
    tangential : whether it is independent of n . H n, with n the normal g / |g|, as all curvatures of level sets are;
        two tangents are then enough instead of three axes
    """

    def linearise(value: Tensor, gradient: Tensor, hessian: Tensor, target: Tensor | None) -> Linearised:
        del target
        residual = vmap(formula)(value, gradient, hessian)
        by_value, by_gradient, by_hessian = vmap(jacrev(formula, argnums=(0, 1, 2)))(value, gradient, hessian)
        return Linearised(residual, by_value, by_gradient, (by_hessian + by_hessian.mT) / 2)

    return SecondOrder(name, linearise, tangential)
