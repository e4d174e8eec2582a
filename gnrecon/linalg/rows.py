"""One layer's share of Jacobian rows as sums of two outer products, and what can be done without multiplying them out.

Row n is  l_n (i_n, 1)^T + r_n (t_n, 0)^T,  an (out, in + 1) matrix laid out as the weights row by row and then the
biases. With V and b the same layout of a vector v:

    J v    row n:   l_n . (V i_n + b) + r_n . (V t_n)                   two GEMMs
    J^T u           sum_n u_n l_n (i_n, 1)^T + u_n r_n (t_n, 0)^T       two GEMMs
    J J^T  entry:   (l.l')(i.i' + 1) + (l.r')(i.t') + (r.l')(t.i') + (r.r')(t.t')

The last line is a sum of Hadamard products of layer Gram matrices, so that J J^T costs O(M^2 width) instead of O(M^2
p).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class LayerRows:
    """One layer's share of M Jacobian rows: ``left (inputs, 1)^T + right (tangents, 0)^T``, never multiplied out.

    `left` and `right` have shape (M, out), `inputs` and `tangents` (M, in); `right` and `tangents` are None for rows
    that are a single outer product.
    """

    left: Tensor
    inputs: Tensor
    right: Tensor | None = None
    tangents: Tensor | None = None

    def __len__(self) -> int:
        return len(self.left)

    @property
    def size(self) -> int:
        """Number of columns."""
        return self.left.shape[1] * (self.inputs.shape[1] + 1)

    @property
    def bytes(self) -> int:
        """Memory of the factors, shared ones counted here too."""
        return sum(part.numel() * part.element_size() for part in self._parts() if part is not None)

    def _parts(self) -> tuple[Tensor, Tensor, Tensor | None, Tensor | None]:
        return self.left, self.inputs, self.right, self.tangents

    def into(self, units: Tensor) -> LayerRows:
        """Return the columns of the parameters that lead into the given output units, of shape (k,)."""
        right = None if self.right is None else self.right[:, units]
        return LayerRows(self.left[:, units], self.inputs, right, self.tangents)

    def take(self, rows: Tensor | slice) -> LayerRows:
        """Return some of the rows."""
        left, inputs, right, tangents = (None if part is None else part[rows] for part in self._parts())
        assert left is not None
        assert inputs is not None
        return LayerRows(left, inputs, right, tangents)

    def times(self, scale: Tensor) -> LayerRows:
        """Return the rows multiplied by `scale`, of shape (M,)."""
        tangents = None if self.tangents is None else self.tangents * scale[:, None]
        return LayerRows(self.left * scale[:, None], self.inputs, self.right, tangents)

    def write(self, block: Tensor) -> None:
        """Write the rows into `block`, of shape (M, size)."""
        out, into = self.left.shape[1], self.inputs.shape[1]
        weights = block[:, : out * into].view(len(block), out, into)
        torch.mul(self.left[:, :, None], self.inputs[:, None, :], out=weights)
        if self.right is not None and self.tangents is not None:
            weights.addcmul_(self.right[:, :, None], self.tangents[:, None, :])
        block[:, out * into :] = self.left

    def mv(self, v: Tensor) -> Tensor:
        """Return J v, of shape (M,), for v of shape (size,)."""
        out, into = self.left.shape[1], self.inputs.shape[1]
        weights = v[: out * into].view(out, into)
        # l . (V i + b) + r . (V t)
        product = torch.addmm(v[out * into :], self.inputs, weights.T).mul_(self.left)
        if self.right is not None and self.tangents is not None:
            product.addcmul_(self.tangents @ weights.T, self.right)
        return product.sum(1)

    def tmv(self, u: Tensor) -> Tensor:
        """Return J^T u, of shape (size,), for u of shape (M,)."""
        scaled = self.left * u[:, None]
        weights = scaled.T @ self.inputs
        if self.right is not None and self.tangents is not None:
            weights.addmm_((self.right * u[:, None]).T, self.tangents)
        return torch.cat([weights.flatten(), scaled.sum(0)])

    def squares(self) -> Tensor:
        """Return the diagonal of J^T J, of shape (size,)."""
        left = self.left.square()
        # (l i + r t)^2 = l^2 i^2 + 2 (l r) (i t) + r^2 t^2, each again an outer product
        weights = left.T @ self.inputs.square()
        if self.right is not None and self.tangents is not None:
            weights.addmm_((self.left * self.right).T, self.inputs * self.tangents, alpha=2.0)
            weights.addmm_(self.right.square().T, self.tangents.square())
        return torch.cat([weights.flatten(), left.sum(0)])

    def row_squares(self) -> Tensor:
        """Return the squared lengths of the rows, the diagonal of J J^T, of shape (M,)."""
        squares = self.inputs.square().sum(1).add_(1.0).mul_(self.left.square().sum(1))
        if self.right is not None and self.tangents is not None:
            # |l i^T + r t^T|^2 = |l|^2 |i|^2 + 2 (l.r)(i.t) + |r|^2 |t|^2
            squares.addcmul_((self.left * self.right).sum(1), (self.inputs * self.tangents).sum(1), value=2.0)
            squares.addcmul_(self.right.square().sum(1), self.tangents.square().sum(1))
        return squares

    def kernel(self, other: LayerRows) -> Tensor:
        """Return J J'^T, of shape (M, M'), by Hadamard products of Gram matrices."""
        product = (self.inputs @ other.inputs.T).add_(1.0).mul_(self.left @ other.left.T)
        mine, theirs = self.right is not None, other.right is not None
        if theirs:
            product.addcmul_(self.left @ _known(other.right).T, self.inputs @ _known(other.tangents).T)
        if mine:
            product.addcmul_(_known(self.right) @ other.left.T, _known(self.tangents) @ other.inputs.T)
        if mine and theirs:
            product.addcmul_(
                _known(self.right) @ _known(other.right).T, _known(self.tangents) @ _known(other.tangents).T
            )
        return product


def _known(part: Tensor | None) -> Tensor:
    assert part is not None, "right and tangents come together"
    return part
