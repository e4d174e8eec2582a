"""One layer's columns of Jacobian rows as sums of outer products, and products with them that never form the rows.

Row n is  l_n (i_n, 1)^T + r_n (t_n, 0)^T,  an (out, in + 1) matrix arranged as the weights row by row and then the
biases; rows of second derivatives have further pairs r, t. With V and b the same layout of a vector v:

    J v    row n:   l_n . (V i_n + b) + r_n . (V t_n)                   two GEMMs
    J^T u           sum_n u_n l_n (i_n, 1)^T + u_n r_n (t_n, 0)^T       two GEMMs
    J J^T  entry:   (l.l')(i.i' + 1) + (l.r')(i.t') + (r.l')(t.i') + (r.r')(t.t')

The last line is a sum of Hadamard products of layer Gram matrices, so that J J^T costs O(M^2 width) instead of O(M^2
p).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property, partial, reduce

import torch
from torch import Tensor

from gnrecon.runtime.chunks import slices
from gnrecon.runtime.matrix_product import matmul
from gnrecon.runtime.parallel import map_in_threads

Pair = tuple[Tensor, Tensor]


@dataclass(frozen=True)
class LayerRows:
    """One layer's share of M Jacobian rows: ``left (inputs, 1)^T + right (tangents, 0)^T``, never multiplied out.

    `left` and `right` have shape (M, out), `inputs` and `tangents` (M, in); `right` and `tangents` are None for rows
    that are a single outer product. `further` holds more pairs like (right, tangents), to be added.
    """

    left: Tensor
    inputs: Tensor
    right: Tensor | None = None
    tangents: Tensor | None = None
    further: tuple[Pair, ...] = ()

    def __len__(self) -> int:
        return len(self.left)

    @property
    def size(self) -> int:
        """Number of columns."""
        return self.left.shape[1] * (self.inputs.shape[1] + 1)

    @property
    def pairs(self) -> tuple[Pair, ...]:
        """All outer products but the first, as (right, tangents)."""
        if self.right is None or self.tangents is None:
            return self.further
        return ((self.right, self.tangents), *self.further)

    @cached_property
    def _stacked(self) -> tuple[Tensor, Tensor]:
        """All left factors, of shape (M, k, out), and their right ones, of shape (M, k, in)."""
        pairs = ((self.left, self.inputs), *self.pairs)
        return torch.stack([left for left, _ in pairs], 1), torch.stack([inputs for _, inputs in pairs], 1)

    @property
    def bytes(self) -> int:
        """Memory of the factors, shared ones counted here too."""
        parts = [self.left, self.inputs, *(part for pair in self.pairs for part in pair)]
        return sum(part.numel() * part.element_size() for part in parts)

    def into(self, units: Tensor) -> LayerRows:
        """Return the columns of the parameters that lead into the given output units, of shape (k,)."""
        return _of(self.left[:, units], self.inputs, [(right[:, units], tangents) for right, tangents in self.pairs])

    def to(self, stored: torch.dtype) -> LayerRows:
        """Return the rows in another precision."""
        pairs = [(right.to(stored), tangents.to(stored)) for right, tangents in self.pairs]
        return _of(self.left.to(stored), self.inputs.to(stored), pairs)

    def take(self, rows: Tensor | slice) -> LayerRows:
        """Return some of the rows."""
        pairs = [(right[rows], tangents[rows]) for right, tangents in self.pairs]
        return _of(self.left[rows], self.inputs[rows], pairs)

    def times(self, scale: Tensor) -> LayerRows:
        """Return the rows multiplied by `scale`, of shape (M,)."""
        pairs = [(right, tangents * scale[:, None]) for right, tangents in self.pairs]
        return _of(self.left * scale[:, None], self.inputs, pairs)

    def write(self, block: Tensor) -> None:
        """Write the rows into `block`, of shape (M, size)."""
        out, into = self.left.shape[1], self.inputs.shape[1]
        weights = block[:, : out * into].view(len(block), out, into)
        if self.further:
            # One small product per row passes over the block once; adding outer products would pass over it for each.
            lefts, rights = self._stacked
            torch.bmm(lefts.mT, rights, out=weights)
        else:
            torch.mul(self.left[:, :, None], self.inputs[:, None, :], out=weights)
            for right, tangents in self.pairs:
                weights.addcmul_(right[:, :, None], tangents[:, None, :])
        block[:, out * into :] = self.left

    def write_runs(self, length: int, block: Tensor) -> None:
        """Write the sum of each `length` successive rows over the root of that into `block`, of shape (runs, size).

        Where M is no multiple of the length, one more has the rows that are left, over the root of their number.
        """
        if length == 1:
            self.write(block)
            return
        out, into = self.left.shape[1], self.inputs.shape[1]
        lefts, rights = self._stacked
        for rows, count, place in _runs(len(self), length):
            runs = place.stop - place.start
            # The sum of a run's outer products is one product of matrices, (out, k count) by (k count, in).
            ends = [part[rows].reshape(runs, count * part.shape[1], part.shape[2]) for part in (lefts, rights)]
            block[place, : out * into] = torch.bmm(ends[0].mT, ends[1]).flatten(1)
            torch.sum(self.left[rows].view(runs, count, out), 1, out=block[place, out * into :])
            block[place].div_(math.sqrt(count))

    def mv(self, v: Tensor) -> Tensor:
        """Return J v, of shape (M,), for v of shape (size,)."""
        out, into = self.left.shape[1], self.inputs.shape[1]
        weights = v[: out * into].view(out, into)
        if self.further:
            # One product for all pairs; for a single pair, stacking would cost more than it saves.
            lefts, rights = self._stacked
            product = matmul(rights.flatten(0, 1), weights.T).view_as(lefts)
            product[:, 0] += v[out * into :]
            return product.mul_(lefts).sum((1, 2))
        # l . (V i + b) + r . (V t)
        product = matmul(self.inputs, weights.T).add_(v[out * into :]).mul_(self.left)
        for right, tangents in self.pairs:
            product.addcmul_(matmul(tangents, weights.T), right)
        return product.sum(1)

    def tmv(self, u: Tensor) -> Tensor:
        """Return J^T u, of shape (size,), for u of shape (M,)."""
        if self.further:
            lefts, rights = self._stacked
            along = matmul((lefts * u[:, None, None]).flatten(0, 1).T, rights.flatten(0, 1))
            return torch.cat([along.flatten(), self.left.T @ u])
        scaled = self.left * u[:, None]
        weights = matmul(scaled.T, self.inputs)
        for right, tangents in self.pairs:
            weights += matmul((right * u[:, None]).T, tangents)
        return torch.cat([weights.flatten(), scaled.sum(0)])

    def squares(self) -> Tensor:
        """Return the diagonal of J^T J, of shape (size,)."""
        left = self.left.square()
        # (l i + r t)^2 = l^2 i^2 + 2 (l r) (i t) + r^2 t^2, each again an outer product
        weights = matmul(left.T, self.inputs.square())
        terms = [(self.left, self.inputs), *self.pairs]
        for place, (right, tangents) in enumerate(self.pairs, 1):
            for other, inputs in terms[:place]:
                weights += matmul((other * right).mul_(2.0).T, inputs * tangents)
            weights += matmul(right.square().T, tangents.square())
        return torch.cat([weights.flatten(), left.sum(0)])

    def row_squares(self) -> Tensor:
        """Return the squared lengths of the rows, the diagonal of J J^T, of shape (M,)."""
        squares = self.inputs.square().sum(1).add_(1.0).mul_(self.left.square().sum(1))
        terms = [(self.left, self.inputs), *self.pairs]
        for place, (right, tangents) in enumerate(self.pairs, 1):
            # |l i^T + r t^T|^2 = |l|^2 |i|^2 + 2 (l.r)(i.t) + |r|^2 |t|^2
            for other, inputs in terms[:place]:
                squares.addcmul_((other * right).sum(1), (inputs * tangents).sum(1), value=2.0)
            squares.addcmul_(right.square().sum(1), tangents.square().sum(1))
        return squares

    def kernel(self, other: LayerRows) -> Tensor:
        """Return J J'^T, of shape (M, M'), by Hadamard products of Gram matrices."""
        product = (self.inputs @ other.inputs.T).add_(1.0).mul_(self.left @ other.left.T)
        for right, tangents in other.pairs:
            product.addcmul_(self.left @ right.T, self.inputs @ tangents.T)
        for right, tangents in self.pairs:
            product.addcmul_(right @ other.left.T, tangents @ other.inputs.T)
            for their_right, their_tangents in other.pairs:
                product.addcmul_(right @ their_right.T, tangents @ their_tangents.T)
        return product


def _of(left: Tensor, inputs: Tensor, pairs: list[Pair]) -> LayerRows:
    """Return rows from their outer products."""
    right, tangents = pairs[0] if pairs else (None, None)
    return LayerRows(left, inputs, right, tangents, tuple(pairs[1:]))


def _runs(rows: int, length: int) -> list[tuple[slice, int, slice]]:
    """Return the rows of whole runs, and those that are left for a shorter one; the rows of a run; the runs' places."""
    count = rows // length
    whole = count * length
    parts = [(slice(0, whole), length, slice(0, count)), (slice(whole, rows), rows - whole, slice(count, count + 1))]
    return [(part, run, place) for part, run, place in parts if part.stop > part.start]


# Accumulating J^T J from chunks of rows, as a symmetric rank-k update.
#
# Only the blocks on and below the diagonal are computed, which halves the work of a full product at the same rate. J
# itself is never stored.


def gram(chunks: Iterable[Tensor], size: int, like: Tensor, *, block_columns: int = 192) -> Tensor:
    """Return J^T J, of shape (size, size), its lower triangle valid, summed in `like`'s precision and on its device.

    Parameters
    ----------
    chunks : J's rows, of shape (m, size); a chunk in lower precision is multiplied in that precision, which is faster,
        and only the sums have that of `like`
    size : number of columns of J
    like : tensor whose dtype and device are used
    block_columns : columns of a block on the CPU; large enough for fast matrix products, and small enough that little
        is computed above the diagonal. A GPU has one product in the time of a few blocks
    """
    if like.device.type != "cpu" or size <= 2 * block_columns:
        # One product: of a matrix by its own transpose, it takes half of the time of another one.
        products = (matmul(rows.T, rows).to(like.dtype) for rows in chunks)
        first = next(products, None)
        return like.new_zeros(size, size) if first is None else reduce(torch.Tensor.add_, products, first)
    product = like.new_zeros(size, size)
    # The last blocks come first: they take longest, and threads that share them end at the same time.
    blocks = slices(size, block_columns)[::-1]
    for rows in chunks:
        # Threads share the blocks and no sum, so that the result is the same for any number of them.
        map_in_threads(partial(_add_block, product, rows), blocks)
    return product


def gram_and_product(
    chunks: Iterable[tuple[Tensor, Tensor]], size: int, like: Tensor, *columns: int
) -> tuple[Tensor, Tensor]:
    """Return J^T J, as `gram` does, and J^T y, of shape (size, *columns), of chunks of J's rows with those of y."""
    right = like.new_zeros(size, *columns)

    def rows() -> Iterator[Tensor]:
        for chunk, wanted in chunks:
            right.add_(chunk.T @ wanted.to(chunk))
            yield chunk

    return gram(rows(), size, like), right


def _add_block(product: Tensor, rows: Tensor, block: slice) -> None:
    """Add the block's rows of J^T J, up to the diagonal."""
    before = slice(0, block.start)
    columns = rows[:, block].T
    product[block, block] += matmul(columns, rows[:, block])
    product[block, before] += matmul(columns, rows[:, before])
