"""Residuals of a field's value f and gradient g, linearised:  dr = by_value df + by_gradient . dg.

The names follow the paper's table of constraints; each function takes values of shape (N,), gradients of shape (N, 3)
and its targets, and returns m residuals for every point. What a network is, or how it is sampled, is not known here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor


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
    """The point, which lies outside of the design region, is not inside of the shape: r = min(0, f).

    With least values as targets, of shape (N,), r = min(0, f - target).
    """
    del gradient
    return _below_zero(value if target is None else value - target, torch.ones_like(value))


def free_space(value: Tensor, gradient: Tensor, target: Tensor | None) -> Linearised:
    """The surface keeps away: f has its target's sign, and is not less in magnitude, r = min(0, sign(t) (f - t)).

    Targets t are of shape (N,); what is nearer to zero, or beyond it, has a residual, and nothing else has.
    """
    del gradient
    assert target is not None, "free space has targets"
    sign = torch.sign(target)
    return _below_zero(sign * (value - target), sign)


def signed_distance(value: Tensor, gradient: Tensor, target: Tensor | None) -> Linearised:
    """The value is known: r = f - target, targets of shape (N,).

    In the paper's table this is *supervised*; and it is *connectedness*, where the points are the critical ones that
    join components and the targets the values that would join them.
    """
    del gradient
    assert target is not None, "signed distances are the targets of this residual"
    return Linearised((value - target)[:, None], torch.ones_like(value)[:, None], None)


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
