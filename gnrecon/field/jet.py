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

import torch
from torch import Tensor

from gnrecon.least_squares.layer_products import LayerRows


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
        # Exactly symmetric, whatever the rounding.
        return (hessian + hessian.mT) / 2

    def _along(self, v: Tensor) -> tuple[list[Tensor], list[Tensor]]:
        """Return D_v a_l and D_v d_l of all layers, for directions v of shape (N, 3)."""
        tangents, z_tangents = [v], []
        for slope, (weights, _) in zip(self.slopes, self.layers[:-1], strict=True):
            z_tangents.append(tangents[-1] @ weights.T)
            tangents.append(slope * z_tangents[-1])
        adjoint_tangents = [torch.zeros_like(self.adjoints[-1])]
        for level in range(len(self.slopes) - 1, -1, -1):
            weights = self.layers[level + 1][0]
            # The outermost adjoint is constant, so its tangent contributes nothing to the layer before it.
            inner = self.slopes[level] * (adjoint_tangents[0] @ weights) if level + 1 < len(self.slopes) else 0.0
            bend = (self.adjoints[level + 1] @ weights).mul_(z_tangents[level]).mul_(self.activations[level + 1])
            adjoint_tangents.insert(0, inner - bend)
        return tangents, adjoint_tangents
