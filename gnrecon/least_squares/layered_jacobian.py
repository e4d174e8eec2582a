"""A Jacobian whose rows are sums of outer products, layer by layer, so that the matrix is never formed.

The factors of the rows are stored, or computed again for each product (see `layer_products`). Products with J and J^T
cost O(M p) time and O(M width) memory. Factors may be stored in float32 while vectors and sums over chunks of rows are
in float64.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar

import torch
from torch import Tensor

from gnrecon.least_squares.jacobian import Block, column_slices
from gnrecon.least_squares.layer_products import gram
from gnrecon.runtime.parallel import map_in_threads

Item = TypeVar("Item")


@dataclass(frozen=True)
class LayeredJacobian:
    """A Jacobian of outer-product rows.

    Parameters
    ----------
    blocks : returns the blocks of rows in order; called for each product, so that it may return stored factors, or
        compute them again where storing them would take too much memory
    rows : M
    group_sizes : number of columns of each layer
    device : of the factors
    dtype : of vectors and sums, float64 or that of the factors
    stored : precision of the factors
    chunk_bytes : memory of the rows that are multiplied out at a time
    tile_rows : rows of the square tiles in which J J^T is formed
    kept : whether the blocks are in memory
    pieces : shares of kept blocks whose sums J^T J are made side by side
    """

    blocks: Callable[[], Iterable[Block]]
    rows: int
    group_sizes: tuple[int, ...]
    device: torch.device
    dtype: torch.dtype = torch.float64
    stored: torch.dtype = torch.float64
    chunk_bytes: int = 64_000_000
    tile_rows: int = 1024
    kept: bool = False
    pieces: int = 2

    @property
    def columns(self) -> int:
        """p."""
        return sum(self.group_sizes)

    @property
    def groups(self) -> tuple[slice, ...]:
        """The layers' columns."""
        return column_slices(self.group_sizes)

    def _zeros(self, *shape: int) -> Tensor:
        return torch.zeros(*shape, dtype=self.dtype, device=self.device)

    def mv(self, v: Tensor) -> Tensor:
        """Return J v, of shape (M,)."""

        def rows_of(block: Block) -> Tensor:
            stored = _stored(block)
            product = self._zeros(len(block[0]))
            for layer, group in zip(block, self.groups, strict=True):
                product += layer.mv(v[group].to(stored))
            return product

        return torch.cat([self._zeros(0), *self._of_blocks(rows_of, self.blocks())])

    def tmv(self, u: Tensor) -> Tensor:
        """Return J^T u, of shape (p,)."""

        def sums_of(placed: tuple[Block, slice]) -> Tensor:
            block, rows = placed
            part = u[rows].to(_stored(block))
            return torch.cat([layer.tmv(part) for layer in block])

        return self._sum(sums_of, _placed(self.blocks()))

    def _sum(self, work: Callable[[Item], Tensor], blocks: Iterable[Item]) -> Tensor:
        """Return the sum of what a function makes of the blocks, of shape (p,), added in their order."""
        total = self._zeros(self.columns)
        for part in self._of_blocks(work, blocks):
            total += part
        return total

    def _of_blocks(self, work: Callable[[Item], Tensor], blocks: Iterable[Item]) -> Iterable[Tensor]:
        """Return what a function makes of each block: in threads where they are kept, else one after the other."""
        if self.kept:
            return map_in_threads(work, list(blocks), self.device, brief=True)
        return map(work, blocks)

    def dense(self) -> Iterator[Tensor]:
        """Yield chunks of rows, in the precision in which the factors are stored, of at most `chunk_bytes`."""
        return self._dense(self.blocks(), self.rows)

    def _chunk(self, block: Block) -> int:
        """Return how many rows are multiplied out at a time."""
        return max(64, self.chunk_bytes // max(block[0].left.element_size() * self.columns, 1))

    def _dense(self, blocks: Iterable[Block], rows: int) -> Iterator[Tensor]:
        """Yield chunks of at most so many rows, of as many blocks as fit: few long products are faster than many."""
        buffer: Tensor | None = None
        filled = 0
        for block in blocks:
            most, start = self._chunk(block), 0
            while start < len(block[0]):
                if buffer is None:
                    # No longer than all rows: fresh memory costs as much as what is written to it.
                    buffer = torch.empty(min(most, rows), self.columns, dtype=_stored(block), device=self.device)
                part = [layer.take(slice(start, start + len(buffer) - filled)) for layer in block]
                chunk = buffer[filled : filled + len(part[0])]
                for layer, group in zip(part, self.groups, strict=True):
                    layer.write(chunk[:, group])
                start, filled = start + len(chunk), filled + len(chunk)
                if filled == len(buffer):
                    yield buffer
                    filled = 0
        if buffer is not None and filled:
            yield buffer[:filled]

    def gram(self) -> Tensor:
        """Return J^T J, its lower triangle valid."""
        small = self.pieces * self.columns**2 * self.dtype.itemsize <= self.chunk_bytes
        if not (small and self.kept and self.device.type == "cpu"):
            return gram(self._nonzero_chunks(self.blocks(), self.rows), self.columns, self._zeros(0))
        # Threads share the blocks and no sum; which blocks a sum has does not depend on the number of threads.
        blocks = list(self.blocks())
        shares = [blocks[number :: self.pieces] for number in range(self.pieces)]
        # Most shares are one product, so that sums in the precision of the products lose nothing.
        like, block_columns = self._zeros(0).to(self.stored), max(self.columns, 1)

        def product_of(share: list[Block]) -> Tensor:
            chunks = self._nonzero_chunks(share, sum(len(block[0]) for block in share))
            return gram(chunks, self.columns, like, block_columns=block_columns)

        total, *others = map_in_threads(product_of, shares, self.device)
        for product in others:
            total += product
        return total.to(self.dtype)

    def _nonzero_chunks(self, blocks: Iterable[Block], rows: int) -> Iterator[Tensor]:
        return self._dense(map(_without_zero_rows, blocks), rows)

    def group_grams(self) -> list[Tensor]:
        """Return the layers' blocks of J^T J, each with a valid lower triangle."""
        return [
            replace(self, blocks=partial(self._layer, k), group_sizes=(size,)).gram()
            for k, size in enumerate(self.group_sizes)
        ]

    def _layer(self, k: int) -> Iterator[Block]:
        return ([block[k]] for block in self.blocks())

    def kernel(self, scales: Sequence[float] | None = None) -> Tensor:
        """Return J S J^T, its lower triangle valid, tile by tile from layer Gram matrices; J is never formed."""
        scales = scales or [1.0] * len(self.group_sizes)
        kernel = self._zeros(self.rows, self.rows)
        tiles = [
            [layer.take(slice(start, start + self.tile_rows)) for layer in block]
            for block in self.blocks()
            for start in range(0, len(block[0]), self.tile_rows)
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
        return self._sum(lambda block: torch.cat([layer.squares() for layer in block]), self.blocks())

    def row_squares(self) -> Tensor:
        """Return the squared lengths of the rows, of shape (M,)."""

        def squares_of(block: Block) -> Tensor:
            squares = self._zeros(len(block[0]))
            for layer in block:
                squares += layer.row_squares()
            return squares

        return torch.cat([self._zeros(0), *self._of_blocks(squares_of, self.blocks())])

    def sample(self, rows: Tensor) -> LayeredJacobian:
        """Return the Jacobian of the given rows, with stored factors."""
        blocks = []
        for block, place in _placed(self.blocks()):
            inside = rows[(rows >= place.start) & (rows < place.stop)] - place.start
            if len(inside):
                blocks.append([layer.take(inside) for layer in block])
        return replace(self, blocks=lambda: blocks, rows=len(rows))

    def rounded(self) -> LayeredJacobian:
        """Return J with factors stored in float32, or itself if they are."""
        if self.stored == torch.float32:
            return self
        blocks = [[layer.to(torch.float32) for layer in block] for block in self.blocks()]
        return replace(self, blocks=lambda: blocks, stored=torch.float32)

    @property
    def constraint_rows(self) -> tuple[int, ...]:
        """Number of rows of each block."""
        return tuple(len(block[0]) for block in self.blocks())

    def run_sums(self, lengths: Sequence[int]) -> Iterator[Tensor]:
        """Yield sums of runs of rows over the roots of their lengths, in storage precision, without forming J."""
        for block, length in zip(self.blocks(), lengths, strict=True):
            count = length * self._chunk(block)
            for start in range(0, len(block[0]), count):
                part = [layer.take(slice(start, start + count)) for layer in block]
                sums = block[0].left.new_empty(-(-len(part[0]) // length), self.columns)
                for layer, group in zip(part, self.groups, strict=True):
                    layer.write_runs(length, sums[:, group])
                yield sums


def _placed(blocks: Iterable[Block]) -> Iterator[tuple[Block, slice]]:
    """Yield blocks with their rows of J."""
    start = 0
    for block in blocks:
        yield block, slice(start, start + len(block[0]))
        start += len(block[0])


def _without_zero_rows(block: Block, *, most_nonzero: float = 0.9) -> Block:
    """Return a block without its zero rows, such as those of inactive constraints.

    If more than the fraction `most_nonzero` of the rows is nonzero, copying costs more than it saves, and the block is
    returned unchanged.
    """
    filled = torch.zeros(len(block[0]), dtype=torch.bool, device=block[0].left.device)
    for layer in block:
        filled |= layer.left.any(1)
        if filled.all():
            return block
        for right, tangents in layer.pairs:
            filled |= right.any(1) & tangents.any(1)
    rows = filled.nonzero()[:, 0]
    return block if len(rows) > most_nonzero * len(filled) else [layer.take(rows) for layer in block]


def _stored(block: Block) -> torch.dtype:
    return block[0].left.dtype
