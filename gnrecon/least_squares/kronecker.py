"""Kronecker-factored preconditioning: each layer's block of J^T J by the nearest Kronecker product.

Row n of a layer is vec(M_n), where M_n = l_n (i_n, 1)^T + r_n (t_n, 0)^T has shape (out, in + 1). Its block of J^T J,
G = sum_n vec(M_n) vec(M_n)^T, is approximated by B (x) A with B (out, out) and A (in + 1, in + 1). Where one of them
is given, the other that minimises |G - B (x) A|_F is

    A = sum_n M_n^T B M_n / |B|_F^2,        B = sum_n M_n A M_n^T / |A|_F^2,

and a few alternations find the best pair, as a power iteration on G with its indices in the order of Van Loan and
Pitsianis (Approximation with Kronecker products, 1993). The M_n are never formed: with l.B l and so on, row by row,

    sum_n M_n^T B M_n = i^T diag(l.B l) i + i^T diag(l.B r) t + t^T diag(r.B l) i + t^T diag(r.B r) t.

If there are many rows, the sums are estimated from rows sampled by length (see `preconditioners.draw_rows`).
With A = Q_a a Q_a^T and B = Q_b b Q_b^T the inverse of B (x) A + mu I is exact and cheap,

    V -> Q_b [(Q_b^T V Q_a) / (b a^T + mu)] Q_a^T.

Sources: Martens and Grosse, Optimizing neural networks with Kronecker-factored approximate curvature (2015); for
derivatives of networks, Dangel, Mueller, Zeinhofer, KFAC for physics-informed neural networks (2024).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import pad

from gnrecon.least_squares.jacobian import Block, Jacobian
from gnrecon.least_squares.krylov import Apply
from gnrecon.least_squares.layer_products import LayerRows
from gnrecon.least_squares.layered_jacobian import LayeredJacobian
from gnrecon.least_squares.preconditioners import draw_rows, positive


@dataclass(frozen=True)
class PreparedLayer:
    """Eigenvectors and eigenvalues of B, of size out, and of A, of size in + 1, and the layer's mean of D."""

    Q_b: Tensor
    b: Tensor
    Q_a: Tensor
    a: Tensor
    metric: float

    def apply(self, r: Tensor, damping: float) -> Tensor:
        """Return (B (x) A + damping D)^-1 r for r of shape (out * (in + 1),), weights row by row and then biases."""
        out, into = len(self.b), len(self.a) - 1
        V = torch.cat([r[: out * into].view(out, into), r[out * into :, None]], 1)
        damped = positive((self.b[:, None] * self.a + damping * self.metric).flatten()).view(out, into + 1)
        V = self.Q_b @ ((self.Q_b.T @ V @ self.Q_a) / damped) @ self.Q_a.T
        return torch.cat([V[:, :into].flatten(), V[:, into]])


@dataclass(frozen=True)
class PreparedKronecker:
    """The layers' factors."""

    layers: Sequence[PreparedLayer]
    groups: Sequence[slice]

    def at(self, damping: float) -> Apply:
        """Return r -> P^-1 r, layer by layer."""
        parts = list(zip(self.layers, self.groups, strict=True))
        return lambda r: torch.cat([layer.apply(r[group], damping) for layer, group in parts])


@dataclass(frozen=True)
class Kronecker:
    """Kronecker factors of each layer: O(rows width^2) a turn to set up, O(width^3) in all, for any damping."""

    turns: int = 3
    rows: int = 10_000

    def prepare(self, jacobian: Jacobian, metric: Tensor, generator: torch.Generator) -> PreparedKronecker:
        """Find the factors.

        Raises
        ------
        ValueError
            When J does not consist of layers' outer products.
        """
        if not isinstance(jacobian, LayeredJacobian):
            raise ValueError(
                "Kronecker factors need the outer products of a layered Jacobian, which this Jacobian does not have."
            )
        blocks = self._blocks(jacobian, generator)
        widths = [layer.left.shape[1] for layer in blocks[0]]
        A, B = [], [torch.eye(out, dtype=metric.dtype, device=metric.device) for out in widths]
        for _ in range(self.turns):
            A = _contracted(blocks, B, _by_outputs)
            B = _contracted(blocks, A, _by_inputs)
        means = [float(metric[group].mean()) if group.stop > group.start else 1.0 for group in jacobian.groups]
        layers = [PreparedLayer(*_eigen(b), *_eigen(a), mean) for b, a, mean in zip(B, A, means, strict=True)]
        return PreparedKronecker(layers, jacobian.groups)

    def _blocks(self, jacobian: LayeredJacobian, generator: torch.Generator) -> list[Block]:
        if jacobian.rows <= self.rows:
            return list(jacobian.blocks())
        drawn, scales = draw_rows(jacobian, self.rows, generator)
        blocks: list[Block] = []
        start = 0
        for block in jacobian.sample(drawn).blocks():
            stop = start + len(block[0])
            blocks.append([layer.times(scales[start:stop].to(layer.left)) for layer in block])
            start = stop
        return blocks

    def describe(self) -> str:
        """Name it."""
        return "Kronecker factors of the layers"


Sides = tuple[list[Tensor], list[Tensor]]
"""The vectors of a layer's outer products on the side of the given factor, and those on the side of the other one."""


def _by_outputs(layer: LayerRows) -> Sides:
    ins = [pad(layer.inputs, (0, 1), value=1.0)]
    ins += [pad(tangents, (0, 1)) for _, tangents in layer.pairs]
    return [layer.left, *(right for right, _ in layer.pairs)], ins


def _by_inputs(layer: LayerRows) -> Sides:
    outs, ins = _by_outputs(layer)
    return ins, outs


def _contracted(blocks: list[Block], factors: list[Tensor], sides: Callable[[LayerRows], Sides]) -> list[Tensor]:
    """Return for each layer the factor that minimises |G - B (x) A|_F, given the other one."""
    sums = [factors[0].new_zeros(())] * len(factors)
    for block in blocks:
        for k, (layer, factor) in enumerate(zip(block, factors, strict=True)):
            given, wanted = sides(layer)
            for u, w in zip(given, wanted, strict=True):
                applied = u @ factor.to(u)
                for u_other, w_other in zip(given, wanted, strict=True):
                    weight = (applied * u_other).sum(1, keepdim=True)
                    sums[k] = sums[k] + ((weight * w).T @ w_other).to(factor)
    return [total / (float(factor.square().sum()) or 1.0) for total, factor in zip(sums, factors, strict=True)]


def _eigen(factor: Tensor) -> tuple[Tensor, Tensor]:
    """Return eigenvectors and eigenvalues of a factor, none of them negative; one that overflowed counts as zero."""
    values, vectors = torch.linalg.eigh(torch.nan_to_num(factor, 0.0, 0.0, 0.0))
    return vectors, values.clamp_min(0.0)
