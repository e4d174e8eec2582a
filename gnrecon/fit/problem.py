"""A field's residuals under a list of terms, as the least-squares problem that the optimisers solve.

Row i of a term with weight w and N points is sqrt(w / N) r_i, so that |r|^2 / 2 is the paper's loss (its equations for
the Monte Carlo quadrature of the loss and of the Gauss-Newton matrix). The Jacobian is an operator made of the factors
of its rows (`linalg.jacobian`); it is never held whole.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from gnrecon.field.networks import Siren
from gnrecon.fit.terms import Term, groups
from gnrecon.least_squares.jacobian import Block, LayeredJacobian
from gnrecon.least_squares.layer_products import LayerRows
from gnrecon.residuals.constraints import Linearised
from gnrecon.runtime.parallel import slices

CHUNK_POINTS, CHUNK_BYTES = 16_384, 64_000_000
"""Points that are evaluated together: so many, or fewer where a layer's activations would take more bytes."""


@dataclass(frozen=True)
class FieldProblem:
    """Terms on a sine network, of which all parameters or those of some units are free.

    Parameters
    ----------
    field : Siren
    terms : the constraints, each on frozen points
    theta : all parameters, of shape (p,), where the problem was posed
    units : for each layer the units whose incoming parameters are free (None: all of them), or None for all layers
    precision : in which the factors of J's rows are made and stored, by default that of theta; residuals keep theta's
    keep_bytes : memory that the factors of J's rows may take; above it they are made afresh for each product
    """

    field: Siren
    terms: Sequence[Term]
    theta: Tensor
    units: tuple[Tensor | None, ...] | None = None
    precision: torch.dtype | None = None
    keep_bytes: int = 1_500_000_000

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
        """Return the weighted residuals, of shape (M,), in the order of `linearise`'s rows."""
        whole = self.whole(theta)
        return torch.cat([rows for group in groups(self.terms) for rows in self._residuals(whole, group)])

    def _residuals(self, whole: Tensor, group: list[Term]) -> Iterator[Tensor]:
        needs_gradient = any(not _is_value_only(term) for term in group)
        for rows in self._chunks(group):
            points = group[0].points[rows]
            if needs_gradient:
                value, gradient = self.field.value_and_gradient(whole, points)
            else:
                value, gradient = self.field.value(whole, points), points
            for term in group:
                linear, scale = _evaluate(term, rows, value, gradient)
                yield (linear.residual * scale).T.flatten()

    def linearise(self, theta: Tensor) -> tuple[LayeredJacobian, Tensor]:
        """Return J, of shape (M, free), and r, of shape (M,), at the free parameters `theta`.

        The factors of J's rows are kept where they take at most `keep_bytes`, and made afresh for each
        product otherwise.
        """
        whole = self.whole(theta).to(self.precision or theta.dtype)
        gathered = groups([term for group in groups(self.terms) for term in _in_precision(group, whole.dtype)])

        def blocks() -> Iterable[Block]:
            return self._blocks(whole, gathered)

        kept = list(blocks()) if self._factor_bytes(whole) <= self.keep_bytes else None
        residual = self.residual(theta)
        source = blocks if kept is None else lambda: kept
        return LayeredJacobian(source, len(residual), self._layer_sizes(), theta.device, stored=whole.dtype), residual

    def _blocks(self, whole: Tensor, gathered: list[list[Term]]) -> Iterator[Block]:
        """Yield the factors of J's rows: for each chunk of points, one block for each residual of each term."""
        for group in gathered:
            for rows in self._chunks(group):
                jet = self.field.jet(whole, group[0].points[rows])
                for term in group:
                    linear, scale = _evaluate(term, rows, jet.value, jet.gradient)
                    for column in range(linear.residual.shape[1]):
                        yield self._free_rows(jet.rows(*_column(linear, column, scale)))

    def _free_rows(self, layers: list[LayerRows]) -> list[LayerRows]:
        if self.units is None:
            return layers
        return [r if units is None else r.into(units) for r, units in zip(layers, self.units, strict=True)]

    def _free_outs(self) -> list[int]:
        """Number of free units of each layer."""
        shapes = self.field.layout.shapes
        chosen = self.units or [None] * len(shapes)
        return [out if units is None else len(units) for (out, _), units in zip(shapes, chosen, strict=True)]

    def _layer_sizes(self) -> tuple[int, ...]:
        shapes = self.field.layout.shapes
        return tuple(out * (into + 1) for out, (_, into) in zip(self._free_outs(), shapes, strict=True))

    def _chunks(self, group: list[Term]) -> list[slice]:
        """Return slices of the group's points, of which the activations take at most `CHUNK_BYTES` a layer."""
        size = max(256, min(CHUNK_POINTS, CHUNK_BYTES // (8 * max(self.field.widths))))
        return slices(len(group[0].points), size)

    def _factor_bytes(self, whole: Tensor) -> int:
        """Memory of all factors: inputs and adjoints once a point, lefts and tangents for each residual."""
        ins, outs = sum(into for _, into in self.field.layout.shapes), sum(self._free_outs())
        numbers = 0
        for group in groups(self.terms):
            numbers += len(group[0]) * (ins + outs)
            for term in group:
                linear = _probe(term)
                numbers += len(term) * linear.residual.shape[1] * (outs + (0 if linear.by_gradient is None else ins))
        return numbers * whole.element_size()


def _column(linear: Linearised, column: int, scale: Tensor) -> tuple[Tensor | None, Tensor | None]:
    """Return the scaled derivatives of one of the m residuals of each point: (N,) by value, (N, 3) by gradient."""
    by_value = None if linear.by_value is None else linear.by_value[:, column] * scale[:, 0]
    by_gradient = None if linear.by_gradient is None else linear.by_gradient[:, column] * scale
    return by_value, by_gradient


def _row_scale(weight: float | Tensor, count: int, like: Tensor) -> Tensor:
    """Return sqrt(weight / N) with shape (1, 1) or (N, 1)."""
    return torch.as_tensor(weight, dtype=like.dtype, device=like.device).div(count).sqrt().reshape(-1, 1)


def _evaluate(term: Term, rows: slice, value: Tensor, gradient: Tensor) -> tuple[Linearised, Tensor]:
    """Return a term's residuals at some of its points, linearised, and the scale of their rows."""
    target = None if term.target is None else term.target[rows]
    linear = term.residual(value, gradient, target)
    weight = term.weight[rows] if isinstance(term.weight, Tensor) else term.weight
    return linear, _row_scale(weight, len(term), linear.residual)


def _in_precision(group: list[Term], dtype: torch.dtype) -> list[Term]:
    """Return the terms of a group with points and targets in `dtype`, the points still one tensor for all of them."""
    points = group[0].points.to(dtype)
    return [
        replace(term, points=points, target=None if term.target is None else term.target.to(dtype)) for term in group
    ]


def _is_value_only(term: Term) -> bool:
    """Whether the residual can be evaluated without the gradient."""
    return _probe(term).by_gradient is None


def _probe(term: Term) -> Linearised:
    """Return what the residual looks like at one point."""
    probe = term.points.new_zeros(1)
    target = None if term.target is None else term.target[:1]
    return term.residual(probe, term.points.new_ones(1, 3), target)
