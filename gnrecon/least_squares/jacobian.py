"""Jacobians as linear operators: the protocol that the solvers use, and one that stores its matrix.

`layered_jacobian` has the one that never forms the matrix. Row scalings such as the paper's sqrt(weight / N) are part
of J; with them J^T J is the paper's Monte Carlo Gauss-Newton matrix.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from gnrecon.least_squares.layer_products import LayerRows, gram

Block = Sequence[LayerRows]
"""Rows as one `LayerRows` a layer."""


class Jacobian(Protocol):
    """J, of shape (rows, columns), as an operator; vectors are in `dtype` on `device`."""

    @property
    def rows(self) -> int:
        """M."""
        ...

    @property
    def columns(self) -> int:
        """p."""
        ...

    @property
    def dtype(self) -> torch.dtype:
        """Precision of vectors, sums and Gram matrices."""
        ...

    @property
    def stored(self) -> torch.dtype:
        """Storage precision of J, in which products of its rows are computed."""
        ...

    @property
    def device(self) -> torch.device:
        """Device of all tensors."""
        ...

    @property
    def groups(self) -> tuple[slice, ...]:
        """Columns that belong together, such as a layer's."""
        ...

    def mv(self, v: Tensor) -> Tensor:
        """Return J v, of shape (M,), for v of shape (p,)."""
        ...

    def tmv(self, u: Tensor) -> Tensor:
        """Return J^T u, of shape (p,), for u of shape (M,)."""
        ...

    def dense(self) -> Iterator[Tensor]:
        """Yield J's rows in order, of shape (m, p), chunk by chunk; a chunk may be overwritten by the next one."""
        ...

    def gram(self) -> Tensor:
        """Return J^T J, of shape (p, p), of which the lower triangle is valid."""
        ...

    def group_grams(self) -> list[Tensor]:
        """Return the diagonal blocks of J^T J for `groups`, each with a valid lower triangle."""
        ...

    def kernel(self, scales: Sequence[float] | None = None) -> Tensor:
        """Return J S J^T, of shape (M, M), of which the lower triangle is valid; S scales each group, by default 1."""
        ...

    def diagonal(self) -> Tensor:
        """Return the diagonal of J^T J, of shape (p,)."""
        ...

    def row_squares(self) -> Tensor:
        """Return the squared lengths of the rows, of shape (M,)."""
        ...

    def sample(self, rows: Tensor) -> Jacobian:
        """Return the Jacobian of the given rows, of shape (m,), in ascending order."""
        ...

    def rounded(self) -> Jacobian:
        """Return J stored in float32 with unchanged vectors, or itself if both must have the same precision."""
        ...

    @property
    def constraint_rows(self) -> tuple[int, ...]:
        """Number of rows of each constraint, in order."""
        ...

    def run_sums(self, lengths: Sequence[int]) -> Iterator[Tensor]:
        """Yield sums of runs of successive rows over the roots of their lengths, of shape (m, p), chunk by chunk.

        There is one length for each constraint; the last run of a constraint may be shorter.
        """
        ...


@dataclass(frozen=True)
class DenseJacobian:
    """A Jacobian stored as a matrix of shape (M, p)."""

    matrix: Tensor
    group_sizes: tuple[int, ...] | None = None
    chunk: int = 4096

    @property
    def rows(self) -> int:
        """M."""
        return self.matrix.shape[0]

    @property
    def columns(self) -> int:
        """p."""
        return self.matrix.shape[1]

    @property
    def dtype(self) -> torch.dtype:
        """Precision of the matrix and of all results."""
        return self.matrix.dtype

    @property
    def stored(self) -> torch.dtype:
        """Precision of the matrix."""
        return self.matrix.dtype

    @property
    def device(self) -> torch.device:
        """Device of the matrix."""
        return self.matrix.device

    @property
    def groups(self) -> tuple[slice, ...]:
        """The given groups, or all columns as one."""
        return column_slices(self.group_sizes or (self.columns,))

    def mv(self, v: Tensor) -> Tensor:
        """Return J v, of shape (M,)."""
        return self.matrix @ v

    def tmv(self, u: Tensor) -> Tensor:
        """Return J^T u, of shape (p,)."""
        return self.matrix.T @ u

    def dense(self) -> Iterator[Tensor]:
        """Yield chunks of rows."""
        for start in range(0, self.rows, self.chunk):
            yield self.matrix[start : start + self.chunk]

    def gram(self) -> Tensor:
        """Return J^T J, its lower triangle valid."""
        return gram(self.dense(), self.columns, self.matrix)

    def group_grams(self) -> list[Tensor]:
        """Return the groups' blocks of J^T J."""
        return [self.matrix[:, group].T @ self.matrix[:, group] for group in self.groups]

    def kernel(self, scales: Sequence[float] | None = None) -> Tensor:
        """Return J S J^T."""
        if scales is None:
            return self.matrix @ self.matrix.T
        parts = [self.matrix[:, group] for group in self.groups]
        return sum((s * (part @ part.T) for s, part in zip(scales, parts, strict=True)), self.matrix.new_zeros(()))

    def diagonal(self) -> Tensor:
        """Return the diagonal of J^T J, of shape (p,)."""
        return self.matrix.square().sum(0)

    def row_squares(self) -> Tensor:
        """Return the squared lengths of the rows, of shape (M,)."""
        return self.matrix.square().sum(1)

    def sample(self, rows: Tensor) -> DenseJacobian:
        """Return the Jacobian of the given rows."""
        return DenseJacobian(self.matrix[rows], self.group_sizes, self.chunk)

    def rounded(self) -> DenseJacobian:
        """Return itself: vectors have the matrix's precision."""
        return self

    @property
    def constraint_rows(self) -> tuple[int, ...]:
        """All rows as one constraint."""
        return (self.rows,)

    def run_sums(self, lengths: Sequence[int]) -> Iterator[Tensor]:
        """Yield sums of runs of rows over the roots of their lengths, chunk by chunk."""
        for start in range(0, self.rows, self.chunk * lengths[0]):
            rows = self.matrix[start : start + self.chunk * lengths[0]]
            runs = [rows[first : first + lengths[0]] for first in range(0, len(rows), lengths[0])]
            yield torch.stack([run.sum(0) / math.sqrt(len(run)) for run in runs])


def column_slices(sizes: Sequence[int]) -> tuple[slice, ...]:
    """Return the slices of successive groups of columns, given the size of each group."""
    slices, start = [], 0
    for size in sizes:
        slices.append(slice(start, start + size))
        start += size
    return tuple(slices)
