"""Rows of the parameter Jacobian in closed form, from one forward and one backward pass.

With activations a_l and adjoints d_l = df/dz_l, f by (W_l, b_l) is the outer product d_l (a_{l-1}, 1)^T.
A directional derivative D_v f = v . grad f is that product differentiated along v:

    D_v f  by W_l:  (D_v d_l) a_{l-1}^T + d_l (D_v a_{l-1})^T        by b_l:  D_v d_l

so a residual linearised to  c df + v . d(grad f)  has, per layer, the row  (c d + D_v d) a^T + d (D_v a)^T  with bias
c d + D_v d: two outer products, whatever the depth of the network, and no nested differentiation. The tangents follow

    D_v z_l = W_l D_v a_{l-1},   D_v a_l = cos z_l o D_v z_l,
    D_v d_l = cos z_l o (W_{l+1}^T D_v d_{l+1}) - sin z_l o D_v z_l o (W_{l+1}^T d_{l+1}).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from gnrecon.field.layers import Activation, Index, parted
from gnrecon.least_squares.layer_products import LayerRows
from gnrecon.runtime.matrix_product import matmul


@dataclass(frozen=True)
class Jet:
    """A field's value, gradient and parameter derivatives at N points.

    Parameters
    ----------
    layers : weights (out, in) and biases (out,) of each layer
    activations : a_0 = x to a_L, each of shape (N, width)
    slopes : cos z_l of the hidden layers
    adjoints : d_l of all layers, the last being one
    value : f, of shape (N,)
    gradient : grad f in space, of shape (N, 3)
    """

    layers: list[tuple[Tensor, Tensor]]
    activations: list[Tensor]
    slopes: list[Tensor]
    adjoints: list[Tensor]
    value: Tensor
    gradient: Tensor

    def rows(self, by_value: Tensor | None, by_gradient: Tensor | None) -> list[LayerRows]:
        """Return the Jacobian rows of residuals with dr = by_value df + by_gradient . d(grad f), a layer each.

        Parameters
        ----------
        by_value : of shape (N,), or None where the residuals do not depend on the value
        by_gradient : of shape (N, 3), or None where they do not depend on the gradient
        """
        if by_gradient is None:
            assert by_value is not None, "a residual depends on the value or on the gradient"
            scale = by_value[:, None]
            return [LayerRows(d * scale, a, None, None) for d, a in zip(self.adjoints, self.activations, strict=True)]
        tangents, adjoint_tangents = self._along(by_gradient)
        if by_value is not None:
            adjoint_tangents = [
                t.addcmul(d, by_value[:, None]) for t, d in zip(adjoint_tangents, self.adjoints, strict=True)
            ]
        return [
            LayerRows(left, inputs, right, tangent)
            for left, inputs, right, tangent in zip(
                adjoint_tangents, self.activations, self.adjoints, tangents, strict=True
            )
        ]

    def hessian(self) -> Tensor:
        """Return the second derivatives of f in space, of shape (N, 3, 3): D_v (W_1^T d_1) along each axis v."""
        columns = []
        for axis in torch.eye(3).to(self.gradient):
            adjoint_tangents = self._along(axis.expand_as(self.gradient))[1]
            columns.append(adjoint_tangents[0] @ self.layers[0][0])
        hessian = torch.stack(columns, dim=2)
        # Exactly symmetric despite rounding.
        return (hessian + hessian.mT) / 2

    def _along(self, v: Tensor) -> tuple[list[Tensor], list[Tensor]]:
        """Return D_v a_l and D_v d_l of all layers, for directions v of shape (N, 3)."""
        tangents, z_tangents = [v], []
        for slope, (weights, _) in zip(self.slopes, self.layers[:-1], strict=True):
            z_tangents.append(matmul(tangents[-1], weights.T))
            tangents.append(slope * z_tangents[-1])
        adjoint_tangents = [torch.zeros_like(self.adjoints[-1])]
        for level in range(len(self.slopes) - 1, -1, -1):
            weights = self.layers[level + 1][0]
            # The outermost adjoint is constant, so its tangent is zero.
            inner = self.slopes[level] * matmul(adjoint_tangents[0], weights) if level + 1 < len(self.slopes) else 0.0
            bend = matmul(self.adjoints[level + 1], weights).mul_(z_tangents[level]).mul_(self.activations[level + 1])
            adjoint_tangents.insert(0, inner - bend)
        return tangents, adjoint_tangents


Layers = list[tuple[Tensor, Tensor]]

Derivatives = dict[Index, Tensor]


# Second derivatives in space, and rows of the parameter Jacobian for residuals of them, in closed form.
#
# With activations a_l, adjoints d_l = df/dz_l and D_i the derivative along an axis of space, `Jet` computes rows of
# c df + v . d(grad f) from d a^T. A residual of curvature also has a part M : d(Hess f) with M symmetric. With the
# operator P = v . grad + sum_ij M_ij D_i D_j its row is, per layer,
#
#     (c d + P d) a^T  +  d (P a)^T  +  2 sum_i (D_i d) (sum_j M_ij D_j a)^T         bias: c d + P d,
#
# five outer products whatever the depth. With D_i z = W D_i a and P z = W P a of the layer before, a unit s takes
#
#     D_i s(z) = s' D_i z,        P s(z) = s' P z + s'' sum_ij M_ij D_i z D_j z,
#
# and the adjoints d_l = s' e with e = W_{l+1}^T d_{l+1} follow backwards by the product rule,
#
#     D_i d = (D_i s') e + s' D_i e,     P d = (P s') e + 2 sum_i (D_i s') (sum_j M_ij D_j e) + s' P e,
#
# so there is one forward and one backward pass for the axes, for any number of residuals, and one for each residual's
# P. Units of several numbers (wavelets) sum over them. No automatic differentiation is nested; the tests compare with
# `torch.func`.
#
# The axes may be other directions u_1 .. u_K, which differ between points: D_i = u_i . grad, and P's second part is
# sum_ij (U M U^T)_ij D_i D_j if M has no part off their span. The curvatures of a surface need only its two tangents,
# which saves a third of the work for the axes and one of the five outer products.


@dataclass(frozen=True)
class Axes:
    """D_i z and D_i a of the layers, D_i e and D_i d, each of shape (K, N, width); z and d with their q parts."""

    z: list[Tensor]
    activations: list[Tensor]
    outer: list[Tensor]
    adjoints: list[Tensor]


@dataclass(frozen=True)
class CurvedJet:
    """A field's value and its first and second derivatives at N points, with their derivatives by the parameters.

    Parameters
    ----------
    layers : weights (out, in) and biases (out,) of each layer; a unit of q numbers has q rows, unit by unit within each
    activation : of the hidden units
    activations : a_0 = x to a_L, each of shape (N, units)
    derivatives : of the hidden units at z_l
    outer : e_l = W_{l+1}^T d_{l+1} of the hidden layers, of shape (N, units)
    adjoints : d_l of all layers, of shape (N, q units), the last being one
    value : f, of shape (N,)
    gradient : grad f in space, of shape (N, 3)
    directions : orthonormal, of shape (K, N, 3), along which second derivatives are taken; by default the axes of space
    """

    layers: Layers
    activation: Activation
    activations: list[Tensor]
    derivatives: list[Derivatives]
    outer: list[Tensor]
    adjoints: list[Tensor]
    value: Tensor
    gradient: Tensor
    directions: Tensor | None = None

    @classmethod
    def of(cls, layers: Layers, activation: Activation, x: Tensor, order: int = 3) -> CurvedJet:
        """Run forwards and backwards once, at points x of shape (N, 3).

        `order` is that of the units' derivatives: 1 for value and gradient, 2 for first-order rows or the Hessian, 3
        for all.
        """
        activations, derivatives = [x], []
        for weights, bias in layers[:-1]:
            z = parted(torch.addmm(bias, activations[-1], weights.T), activation.inputs)
            derivatives.append(activation.derivatives(z, order))
            activations.append(derivatives[-1][()])
        value = (activations[-1] @ layers[-1][0][0]) + layers[-1][1]
        outer: list[Tensor] = []
        adjoints = [torch.ones_like(value)[:, None]]
        for made, (weights, _) in zip(reversed(derivatives), reversed(layers[1:]), strict=True):
            outer.insert(0, adjoints[0] @ weights)
            adjoints.insert(0, torch.cat([made[(p,)] * outer[0] for p in range(activation.inputs)], dim=-1))
        return cls(layers, activation, activations, derivatives, outer, adjoints, value, adjoints[0] @ layers[0][0])

    @cached_property
    def axes(self) -> Axes:
        """Derivatives of everything along the directions."""
        start = self.directions
        if start is None:
            start = torch.eye(3).to(self.gradient)[:, None, :].expand(3, len(self.value), 3)
        z, activations = [], [start]
        for made, (weights, _) in zip(self.derivatives, self.layers, strict=False):
            z.append(self._parts(activations[-1] @ weights.T))
            activations.append(self._chain(made, (), z[-1]))
        adjoints = [torch.zeros_like(self.adjoints[-1]).expand(len(start), -1, -1)]
        outer: list[Tensor] = []
        for level in reversed(range(len(self.derivatives))):
            made, weights = self.derivatives[level], self.layers[level + 1][0]
            outer.insert(0, adjoints[0] @ weights)
            parts = [
                self._chain(made, (p,), z[level]) * self.outer[level] + made[(p,)] * outer[0]
                for p in range(self.activation.inputs)
            ]
            adjoints.insert(0, torch.cat(parts, dim=-1))
        return Axes(z, activations, outer, adjoints)

    @cached_property
    def hessian(self) -> Tensor:
        """Second derivatives of f in space, of shape (N, 3, 3), exactly symmetric.

        With two directions, the second derivative along their complement is unknown and set to zero.
        """
        found = (self.axes.adjoints[0] @ self.layers[0][0]).permute(1, 0, 2)
        if self.directions is not None:
            # U H is known, and H = U^T U H + H U^T U - U^T U H U^T U, except for the part of the complement.
            U = self.directions.permute(1, 0, 2)
            found = U.mT @ (2 * found - (found @ U.mT) @ U)
        return (found + found.mT) / 2

    def rows(
        self, by_value: Tensor | None, by_gradient: Tensor | None, by_hessian: Tensor | None = None
    ) -> list[LayerRows]:
        """Return the rows of residuals with dr = by_value df + by_gradient . d(grad f) + by_hessian : d(Hess f).

        Parameters
        ----------
        by_value : of shape (N,), or None where the residuals do not depend on the value
        by_gradient : of shape (N, 3), or None where they do not depend on the gradient
        by_hessian : of shape (N, 3, 3), symmetric, with no part off the jet's directions, or None where they do not
            depend on second derivatives
        """
        if by_gradient is None and by_hessian is None:
            assert by_value is not None, "a residual depends on the value or on a derivative"
            scale = by_value[:, None]
            return [LayerRows(d * scale, a) for d, a in zip(self.adjoints, self.activations, strict=True)]
        v = torch.zeros_like(self.gradient) if by_gradient is None else by_gradient
        if by_hessian is not None and self.directions is not None:
            U = self.directions.permute(1, 0, 2)
            by_hessian = U @ by_hessian @ U.mT
        tangents, lefts = self._operated(v, by_hessian)
        if by_value is not None:
            lefts = [t.addcmul(d, by_value[:, None]) for t, d in zip(lefts, self.adjoints, strict=True)]
        further = self._crossed(by_hessian)
        return [
            LayerRows(left, inputs, right, tangent, more)
            for left, inputs, right, tangent, more in zip(
                lefts, self.activations, self.adjoints, tangents, further, strict=True
            )
        ]

    def _operated(self, v: Tensor, M: Tensor | None) -> tuple[list[Tensor], list[Tensor]]:
        """Return P a_l and P d_l of all layers."""
        tangents, z_tangents, bends = [v], [], []
        for level, made in enumerate(self.derivatives):
            z_tangents.append(self._parts(tangents[-1] @ self.layers[level][0].T))
            bends.append(None if M is None else self._bends(M, self.axes.z[level]))
            tangents.append(self._operate(made, (), z_tangents[-1], bends[-1]))
        adjoints = [torch.zeros_like(self.adjoints[-1])]
        for level in reversed(range(len(self.derivatives))):
            made, outer = self.derivatives[level], adjoints[0] @ self.layers[level + 1][0]
            parts = []
            for p in range(self.activation.inputs):
                part = self._operate(made, (p,), z_tangents[level], bends[level]) * self.outer[level]
                part.addcmul_(made[(p,)], outer)
                if M is not None:
                    slopes = self._chain(made, (p,), self.axes.z[level])
                    part += 2 * (slopes * _turned(M, self.axes.outer[level])).sum(0)
                parts.append(part)
            adjoints.insert(0, torch.cat(parts, dim=-1))
        return tangents, adjoints

    def _crossed(self, M: Tensor | None) -> list[tuple[tuple[Tensor, Tensor], ...]]:
        """Return 2 D_i d and sum_j M_ij D_j a for each axis, of all layers; the last adjoint is constant."""
        if M is None:
            return [()] * len(self.layers)
        pairs = [
            tuple(zip((2 * adjoints).unbind(0), _turned(M, activations).unbind(0), strict=True))
            for adjoints, activations in zip(self.axes.adjoints[:-1], self.axes.activations[:-1], strict=True)
        ]
        return [*pairs, ()]

    def _parts(self, z: Tensor) -> Tensor:
        """Return numbers of shape (..., q units) as (q, ..., units)."""
        return parted(z, self.activation.inputs).movedim(-2, 0)

    def _chain(self, made: Derivatives, index: Index, z: Tensor) -> Tensor:
        """Return D s for the derivative s of an index, from D z of shape (q, ..., units)."""
        terms = [made[_with(index, p)] * z[p] for p in range(self.activation.inputs)]
        return _summed(terms)

    def _operate(self, made: Derivatives, index: Index, z: Tensor, bends: dict[Index, Tensor] | None) -> Tensor:
        """Return P s for the derivative s of an index, from P z and the bends."""
        operated = self._chain(made, index, z)
        for pair, bend in (bends or {}).items():
            operated = operated.addcmul(made[_with(index, *pair)], bend)
        return operated

    def _bends(self, M: Tensor, z: Tensor) -> dict[Index, Tensor]:
        """Return sum_ij M_ij D_i z_p D_j z_q for each pair p, q of a unit's numbers, both orders of a pair together."""
        turned = [_turned(M, part) for part in z]
        count = self.activation.inputs
        return {(p, q): (z[p] * turned[q]).sum(0) * (1 if p == q else 2) for p in range(count) for q in range(p, count)}


def _turned(M: Tensor, along: Tensor) -> Tensor:
    """Return sum_j M_ij X_j for X of shape (K, N, width), M of shape (N, K, K)."""
    turned = torch.empty_like(along, memory_format=torch.contiguous_format)
    # K^2 passes over cached data are several times as fast as N products of small matrices.
    for row, place in zip(M.unbind(1), turned.unbind(0), strict=True):
        first, *others = row[:, :, None].unbind(1)
        torch.mul(first, along[0], out=place)
        for factor, part in zip(others, along[1:], strict=True):
            place.addcmul_(factor, part)
    return turned


def _with(index: Index, *more: int) -> Index:
    return tuple(sorted((*index, *more)))


def _summed(terms: list[Tensor]) -> Tensor:
    total = terms[0]
    for term in terms[1:]:
        total = total + term
    return total
