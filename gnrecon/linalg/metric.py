"""What a damping is measured in: diagonal metrics D of the parameters.

A damped step minimises |r + J s|^2 + damping |s|_D^2 with |s|_D^2 = s.D s.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from gnrecon.linalg.jacobian import Jacobian

Metric = Callable[[Jacobian], Tensor]
"""Gives D's diagonal, of shape (p,), positive."""

SHARE = 0.1
"""What a parameter's unit has of its layer's, beside its own."""


def identity(jacobian: Jacobian) -> Tensor:
    """Damp every parameter alike (Levenberg), as the paper does."""
    return torch.ones(jacobian.columns, dtype=jacobian.dtype, device=jacobian.device)


def jacobian_scaled(jacobian: Jacobian) -> Tensor:
    """Damp in units of J^T J's diagonal (Marquardt), with a floor for parameters that no residual sees."""
    diagonal = jacobian.diagonal()
    return _bounded(diagonal)


def layer_scaled(jacobian: Jacobian) -> Tensor:
    """Damp each layer in units of the mean of its part of J^T J's diagonal, with a floor as above.

    Layers differ by orders of magnitude in how much the field answers to them, the parameters within a layer do not.
    """
    return _bounded(_layer_means(jacobian, jacobian.diagonal()))


def jacobian_layer_scaled(jacobian: Jacobian) -> Tensor:
    """Damp in units of J^T J's diagonal, to each of which a tenth of its layer's mean is added.

    In units of the diagonal alone, parameters that the residuals hardly see yet move beyond where the linear model
    holds, and the damping must rise for all; with units of layers alone, late steps are shorter (docs/paper.md).
    """
    diagonal = jacobian.diagonal()
    return _bounded(diagonal + SHARE * _layer_means(jacobian, diagonal))


def _layer_means(jacobian: Jacobian, diagonal: Tensor) -> Tensor:
    """Return the mean of its layer's part of the diagonal for each parameter, of shape (p,)."""
    means = torch.ones_like(diagonal)
    for group in jacobian.groups:
        if group.stop > group.start:
            means[group] = diagonal[group].mean()
    return means


def _bounded(diagonal: Tensor) -> Tensor:
    if not diagonal.numel():
        return diagonal
    return diagonal.clamp_min(1e-12 * float(diagonal.max()) + torch.finfo(diagonal.dtype).tiny)
