"""Jacobians as operators: products, Gram matrices and rows, formed or never formed.

What the solvers ask of J, of shape (M, p), stands in the protocol `Jacobian`. `DenseJacobian` holds J.
`LayeredJacobian` holds, or makes afresh for each product, the outer-product factors of its rows (see `linalg.rows`),
so that products with J and J^T cost O(M p) time and O(M width) memory. Row scalings such as the paper's sqrt(weight /
N) are part of the factors; with them J^T J is the paper's Monte Carlo Gauss-Newton matrix.

Factors may be stored in float32 while sums over chunks of rows are kept, and vectors handed out, in float64.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol

import torch
from torch import Tensor

from gnrecon.least_squares.layer_products import LayerRows, gram

Block = Sequence[LayerRows]
"""Rows as one `LayerRows` a layer."""

CHUNK_BYTES = 64_000_000
TILE = 1024
FILLED = 0.9
"""Share of a block's rows below which those of zeros are left out of J^T J."""


class Jacobian(Protocol):
    """J, of shape (rows, columns), as the solvers see it; vectors are in `dtype` on `device`."""

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
        """Precision of J's own numbers, in which products of its rows are made."""
        ...

    @property
    def device(self) -> torch.device:
        """Where everything lies."""
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
        """Return J stored in float32, its vectors as they are, or itself where both must be of one precision."""
        ...

    @property
    def stretches(self) -> tuple[int, ...]:
        """Numbers of successive rows that belong to one constraint."""
        ...

    def runs(self, lengths: Sequence[int]) -> Iterator[Tensor]:
        """Yield sums of runs of successive rows over the roots of their numbers, of shape (m, p), chunk by chunk.

        There is one length for each stretch; the last run of a stretch may be shorter.
        """
        ...


@dataclass(frozen=True)
class DenseJacobian:
    """A Jacobian that is held as a matrix of shape (M, p)."""

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
        """Precision of the matrix, and of all that is made of it."""
        return self.matrix.dtype

    @property
    def stored(self) -> torch.dtype:
        """Precision of the matrix."""
        return self.matrix.dtype

    @property
    def device(self) -> torch.device:
        """Where the matrix lies."""
        return self.matrix.device

    @property
    def groups(self) -> tuple[slice, ...]:
        """The groups that were named, or all columns as one."""
        return _slices(self.group_sizes or (self.columns,))

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
    def stretches(self) -> tuple[int, ...]:
        """All rows as one stretch."""
        return (self.rows,)

    def runs(self, lengths: Sequence[int]) -> Iterator[Tensor]:
        """Yield sums of runs of rows over the roots of their numbers, chunk by chunk."""
        for start in range(0, self.rows, self.chunk * lengths[0]):
            rows = self.matrix[start : start + self.chunk * lengths[0]]
            runs = [rows[first : first + lengths[0]] for first in range(0, len(rows), lengths[0])]
            yield torch.stack([run.sum(0) / math.sqrt(len(run)) for run in runs])


@dataclass(frozen=True)
class LayeredJacobian:
    """A Jacobian of outer-product rows.

    Parameters
    ----------
    blocks : gives the blocks of rows in order; called for each product, so that it may hand out kept factors or make
        them afresh where keeping them would take too much memory
    rows : M
    group_sizes : number of columns of each layer
    device : where the factors lie
    dtype : of vectors and sums, float64 or that of the factors
    stored : precision of the factors
    """

    blocks: Callable[[], Iterable[Block]]
    rows: int
    group_sizes: tuple[int, ...]
    device: torch.device
    dtype: torch.dtype = torch.float64
    stored: torch.dtype = torch.float64

    @property
    def columns(self) -> int:
        """p."""
        return sum(self.group_sizes)

    @property
    def groups(self) -> tuple[slice, ...]:
        """The layers' columns."""
        return _slices(self.group_sizes)

    def _zeros(self, *shape: int) -> Tensor:
        return torch.zeros(*shape, dtype=self.dtype, device=self.device)

    def mv(self, v: Tensor) -> Tensor:
        """Return J v, of shape (M,)."""
        product, start = self._zeros(self.rows), 0
        parts: dict[torch.dtype, list[Tensor]] = {}
        for block in self.blocks():
            stored = _stored(block)
            if stored not in parts:
                parts[stored] = [v[group].to(stored) for group in self.groups]
            stop = start + len(block[0])
            for layer, part in zip(block, parts[stored], strict=True):
                product[start:stop] += layer.mv(part)
            start = stop
        return product

    def tmv(self, u: Tensor) -> Tensor:
        """Return J^T u, of shape (p,)."""
        product, start = self._zeros(self.columns), 0
        for block in self.blocks():
            stop = start + len(block[0])
            part = u[start:stop].to(_stored(block))
            for layer, group in zip(block, self.groups, strict=True):
                product[group] += layer.tmv(part)
            start = stop
        return product

    def dense(self) -> Iterator[Tensor]:
        """Yield chunks of rows, in the precision in which the factors are stored, of at most `CHUNK_BYTES`."""
        return self._dense(self.blocks())

    def _chunk(self, block: Block) -> int:
        """Return how many rows are multiplied out at a time."""
        return max(64, CHUNK_BYTES // max(block[0].left.element_size() * self.columns, 1))

    def _dense(self, blocks: Iterable[Block]) -> Iterator[Tensor]:
        buffer: Tensor | None = None
        for block in blocks:
            if buffer is None:
                length = max(1, min(self._chunk(block), self.rows))
                buffer = torch.empty(length, self.columns, dtype=_stored(block), device=self.device)
            for start in range(0, len(block[0]), len(buffer)):
                part = [layer.take(slice(start, start + len(buffer))) for layer in block]
                chunk = buffer[: len(part[0])]
                for layer, group in zip(part, self.groups, strict=True):
                    layer.write(chunk[:, group])
                yield chunk

    def gram(self) -> Tensor:
        """Return J^T J, its lower triangle valid."""
        return gram(self._dense(map(_filled, self.blocks())), self.columns, self._zeros(0))

    def group_grams(self) -> list[Tensor]:
        """Return the layers' blocks of J^T J, each with a valid lower triangle."""
        grams = []
        for k, size in enumerate(self.group_sizes):
            grams.append(
                LayeredJacobian(
                    partial(self._layer, k), self.rows, (size,), self.device, self.dtype, self.stored
                ).gram()
            )
        return grams

    def _layer(self, k: int) -> Iterator[Block]:
        return ([block[k]] for block in self.blocks())

    def kernel(self, scales: Sequence[float] | None = None) -> Tensor:
        """Return J S J^T, its lower triangle valid, tile by tile from layer Gram matrices; J is never formed."""
        scales = scales or [1.0] * len(self.group_sizes)
        kernel = self._zeros(self.rows, self.rows)
        tiles = [
            [layer.take(slice(start, start + TILE)) for layer in block]
            for block in self.blocks()
            for start in range(0, len(block[0]), TILE)
        ]
        row = 0
        for count, mine in enumerate(tiles):
            column = 0
            for theirs in tiles[: count + 1]:
                place = kernel[row : row + len(mine[0]), column : column + len(theirs[0])]
                for scale, layer, other in zip(scales, mine, theirs, strict=True):
                    place.add_(layer.kernel(other), alpha=scale)
                column += len(theirs[0])
            row += len(mine[0])
        return kernel

    def diagonal(self) -> Tensor:
        """Return the diagonal of J^T J, of shape (p,)."""
        squares = self._zeros(self.columns)
        for block in self.blocks():
            for layer, group in zip(block, self.groups, strict=True):
                squares[group] += layer.squares()
        return squares

    def row_squares(self) -> Tensor:
        """Return the squared lengths of the rows, of shape (M,)."""
        squares, start = self._zeros(self.rows), 0
        for block in self.blocks():
            stop = start + len(block[0])
            for layer in block:
                squares[start:stop] += layer.row_squares()
            start = stop
        return squares

    def sample(self, rows: Tensor) -> LayeredJacobian:
        """Return the Jacobian of the given rows, its factors kept."""
        blocks, start = [], 0
        for block in self.blocks():
            stop = start + len(block[0])
            inside = rows[(rows >= start) & (rows < stop)] - start
            if len(inside):
                blocks.append([layer.take(inside) for layer in block])
            start = stop
        return LayeredJacobian(lambda: blocks, len(rows), self.group_sizes, self.device, self.dtype, self.stored)

    def rounded(self) -> LayeredJacobian:
        """Return J with factors in float32, which are kept, or itself where they are."""
        if self.stored == torch.float32:
            return self
        blocks = [[layer.to(torch.float32) for layer in block] for block in self.blocks()]
        return replace(self, blocks=lambda: blocks, stored=torch.float32)

    @property
    def stretches(self) -> tuple[int, ...]:
        """The blocks' numbers of rows."""
        return tuple(len(block[0]) for block in self.blocks())

    def runs(self, lengths: Sequence[int]) -> Iterator[Tensor]:
        """Yield sums of runs of rows over the roots of their numbers, in the precision of storage, never forming J."""
        for block, length in zip(self.blocks(), lengths, strict=True):
            count = length * self._chunk(block)
            for start in range(0, len(block[0]), count):
                part = [layer.take(slice(start, start + count)) for layer in block]
                sums = block[0].left.new_empty(-(-len(part[0]) // length), self.columns)
                for layer, group in zip(part, self.groups, strict=True):
                    layer.write_runs(length, sums[:, group])
                yield sums


def _filled(block: Block) -> Block:
    """Return a block without its rows of zeros, such as those of constraints that do not act, if there are many."""
    filled = torch.zeros(len(block[0]), dtype=torch.bool, device=block[0].left.device)
    for layer in block:
        filled |= layer.left.any(1)
        for right, tangents in layer.pairs:
            filled |= right.any(1) & tangents.any(1)
    rows = filled.nonzero()[:, 0]
    return block if len(rows) > FILLED * len(filled) else [layer.take(rows) for layer in block]


def _stored(block: Block) -> torch.dtype:
    return block[0].left.dtype


def _slices(sizes: Sequence[int]) -> tuple[slice, ...]:
    slices, start = [], 0
    for size in sizes:
        slices.append(slice(start, start + size))
        start += size
    return tuple(slices)
