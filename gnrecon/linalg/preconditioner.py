"""Preconditioners approximate (J^T J + damping D)^-1: set up once from a Jacobian, then adapted to each damping.

Here what they share, and the two that keep only a part of J^T J near its diagonal: the diagonal itself (Jacobi), and
the diagonal blocks of the groups of columns, such as a network's layers (block Jacobi).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from gnrecon.linalg.cholesky import damped_factor, solve_factored
from gnrecon.linalg.jacobian import Jacobian
from gnrecon.linalg.krylov import Apply


class Prepared(Protocol):
    """A preconditioner of one Jacobian in one metric."""

    def at(self, damping: float) -> Apply:
        """Return r -> P^-1 r, symmetric and positive definite, for P near J^T J + damping D."""
        ...


class Preconditioner(Protocol):
    """A way of approximating J^T J."""

    def prepare(self, jacobian: Jacobian, metric: Tensor, generator: torch.Generator) -> Prepared:
        """Set up from J, of shape (M, p), not empty, and D's diagonal, of shape (p,); chance comes from `generator`."""
        ...

    def describe(self) -> str:
        """Return what it is, as a phrase that follows "preconditioned by"."""
        ...


@dataclass(frozen=True)
class PreparedDiagonal:
    """The diagonals of J^T J and of D, of shape (p,)."""

    diagonal: Tensor
    metric: Tensor

    def at(self, damping: float) -> Apply:
        """Return r -> r / (diagonal + damping D)."""
        inverse = 1.0 / positive(self.diagonal + damping * self.metric)
        return lambda r: inverse * r


@dataclass(frozen=True)
class Jacobi:
    """The diagonal of J^T J + damping D: O(M p / width) to set up from layers, no memory."""

    def prepare(self, jacobian: Jacobian, metric: Tensor, generator: torch.Generator) -> PreparedDiagonal:  # noqa: ARG002
        """Take the diagonal."""
        return PreparedDiagonal(jacobian.diagonal(), metric)

    def describe(self) -> str:
        """Name it."""
        return "the diagonal"


@dataclass(frozen=True)
class PreparedBlocks:
    """Diagonal blocks of J^T J, lower triangles valid, for `groups` of columns."""

    products: Sequence[Tensor]
    groups: Sequence[slice]
    metric: Tensor

    def at(self, damping: float) -> Apply:
        """Return r -> P^-1 r with P block by block J_l^T J_l + damping D_l."""
        factors = [
            definite_factor(product, damping * self.metric[group])
            for product, group in zip(self.products, self.groups, strict=True)
        ]

        def apply(r: Tensor) -> Tensor:
            parts = zip(factors, self.groups, strict=True)
            return torch.cat([solve_factored(factor, r[group]) for factor, group in parts])

        return apply


@dataclass(frozen=True)
class BlockJacobi:
    """The groups' blocks of J^T J: O(M sum p_l^2) to set up, O(sum p_l^3) a damping."""

    def prepare(self, jacobian: Jacobian, metric: Tensor, generator: torch.Generator) -> PreparedBlocks:  # noqa: ARG002
        """Assemble the blocks."""
        return PreparedBlocks(jacobian.group_grams(), jacobian.groups, metric)

    def describe(self) -> str:
        """Name it."""
        return "the blocks of the groups of columns"


def positive(diagonal: Tensor) -> Tensor:
    """Return a diagonal with entries so small that they may be rounding raised to eps of the largest."""
    if not diagonal.numel():
        return diagonal
    largest = float(diagonal.max())
    return diagonal.clamp_min(torch.finfo(diagonal.dtype).eps * largest if largest > 0.0 else 1.0)


def definite_factor(product: Tensor, diagonal: Tensor) -> Tensor:
    """Return the lower Cholesky factor of `product` + diag(`diagonal`), shifted as little as makes it definite.

    A preconditioner may be off, but must be definite; rounding can leave small negative eigenvalues.
    """
    scale = positive(product.diagonal() + diagonal)
    for shift in (0.0, 1e-14, 1e-12, 1e-10, 1e-8, 1e-6, 1e-4, 1e-2):
        factor = damped_factor(product, diagonal + shift * scale)
        if factor is not None:
            return factor
    return torch.diag(scale.sqrt())
