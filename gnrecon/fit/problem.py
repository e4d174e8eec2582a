"""A field's residuals under a list of terms, as the least-squares problem that the optimisers solve.

Row i of a term with weight w and N points is sqrt(w / N) r_i, so that |r|^2 / 2 is the paper's loss (its equations for
the Monte Carlo quadrature of the loss and of the Gauss-Newton matrix). The Jacobian is made a chunk of points at a
time and is never held whole.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from gnrecon.field.jet import LayerRows
from gnrecon.field.siren import Siren, batches
from gnrecon.fit.terms import Term, groups
from gnrecon.residuals.first_order import Linearised


@dataclass(frozen=True)
class FieldProblem:
    """Terms on a sine network, of which all parameters or those of some units are free.

    Parameters
    ----------
    field : Siren
    terms : the constraints, each on frozen points
    theta : all parameters, of shape (p,), where the problem was posed
    units : for each layer the units whose incoming parameters are free (None: all of them), or None for all layers
    chunk_bytes : memory that one chunk of Jacobian rows may take
    """

    field: Siren
    terms: Sequence[Term]
    theta: Tensor
    units: tuple[Tensor | None, ...] | None = None
    chunk_bytes: int = 64_000_000

    @cached_property
    def columns(self) -> Tensor | None:
        """Places of the free parameters in theta, or None when all are free."""
        return None if self.units is None else self.field.layout.columns(self.units).to(self.theta.device)

    def free(self) -> Tensor:
        """Return the free parameters at theta."""
        return self.theta if self.columns is None else self.theta[self.columns]

    def whole(self, free: Tensor) -> Tensor:
        """Return all parameters, of shape (p,), from the free ones."""
        return free if self.columns is None else self.theta.index_copy(0, self.columns, free)

    def residual(self, theta: Tensor) -> Tensor:
        """Return the weighted residuals, of shape (M,)."""
        return torch.cat(list(self._by_term(theta)))

    def _by_term(self, theta: Tensor) -> Iterator[Tensor]:
        """Yield each term's residual rows, scaled by sqrt(weight / N)."""
        whole = self.whole(theta)
        for group in groups(self.terms):
            needs_gradient = any(not _is_value_only(term) for term in group)
            parts = list(self._evaluate(whole, group[0].points, needs_gradient))
            value, gradient = (torch.cat(part) for part in zip(*parts, strict=True))
            for term in group:
                residual = term.residual(value, gradient, term.target).residual
                yield (residual * _row_scale(term.weight, len(term), residual)).flatten()

    def _evaluate(self, whole: Tensor, points: Tensor, needs_gradient: bool) -> Iterator[tuple[Tensor, Tensor]]:
        for rows in batches(len(points), 4096):
            if needs_gradient:
                yield self.field.value_and_gradient(whole, points[rows])
            else:
                yield self.field.value(whole, points[rows]), points[rows]

    def chunks(self, theta: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
        """Yield dense Jacobian rows, of shape (m, free), and residuals, of shape (m,), chunk by chunk."""
        whole = self.whole(theta)
        per_chunk = max(64, self.chunk_bytes // (len(theta) * theta.element_size()))
        buffer = theta.new_empty(per_chunk, len(theta))
        for group in groups(self.terms):
            for rows in batches(len(group[0].points), per_chunk):
                yield from self._group_chunk(whole, group, rows, buffer)

    def _group_chunk(
        self, whole: Tensor, group: list[Term], rows: slice, buffer: Tensor
    ) -> Iterator[tuple[Tensor, Tensor]]:
        points = group[0].points[rows]
        jet = self.field.jet(whole, points)
        for term in group:
            target = None if term.target is None else term.target[rows]
            linear = term.residual(jet.value, jet.gradient, target)
            weight = term.weight[rows] if isinstance(term.weight, Tensor) else term.weight
            scale = _row_scale(weight, len(term), linear.residual)
            for column in range(linear.residual.shape[1]):
                block = buffer[: len(points)]
                self._write(jet.rows(*_column(linear, column, scale)), block)
                yield block, (linear.residual[:, column : column + 1] * scale)[:, 0]

    def _write(self, layers: list[LayerRows], block: Tensor) -> None:
        """Write the free columns of the rows into `block`, of shape (m, free parameters)."""
        offset = 0
        for layer, units in zip(layers, self.units or [None] * len(layers), strict=True):
            chosen = layer if units is None else layer.into(units)
            chosen.write(block[:, offset : offset + chosen.size])
            offset += chosen.size


def _column(linear: Linearised, column: int, scale: Tensor) -> tuple[Tensor | None, Tensor | None]:
    """Return the scaled derivatives of one of the m residuals of each point: (N,) by value, (N, 3) by gradient."""
    by_value = None if linear.by_value is None else linear.by_value[:, column] * scale[:, 0]
    by_gradient = None if linear.by_gradient is None else linear.by_gradient[:, column] * scale
    return by_value, by_gradient


def _row_scale(weight: float | Tensor, count: int, like: Tensor) -> Tensor:
    """Return sqrt(weight / N) with shape (1, 1) or (N, 1)."""
    return torch.as_tensor(weight, dtype=like.dtype, device=like.device).div(count).sqrt().reshape(-1, 1)


def _is_value_only(term: Term) -> bool:
    """Whether the residual can be evaluated without the gradient."""
    probe = term.points.new_zeros(1)
    target = None if term.target is None else term.target[:1]
    return term.residual(probe, term.points.new_ones(1, 3), target).by_gradient is None
