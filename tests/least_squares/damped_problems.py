"""Random Jacobians with their dense matrices, multiplied out by loops, and a table of damped problems."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor

from gnrecon.least_squares import DenseJacobian, Jacobian, LayeredJacobian, LayerRows

F64 = torch.float64


def randn(generator: torch.Generator, *shape: int) -> Tensor:
    """Normal numbers in float64."""
    return torch.randn(*shape, generator=generator, dtype=F64)


def layer_rows(generator: torch.Generator, rows: int, into: int, out: int, pairs: int) -> LayerRows:
    """Random rows of one layer, with so many outer products beside the first."""
    made = [(randn(generator, rows, out), randn(generator, rows, into)) for _ in range(pairs)]
    right, along = made[0] if made else (None, None)
    return LayerRows(randn(generator, rows, out), randn(generator, rows, into), right, along, tuple(made[1:]))


def multiplied_out(layer: LayerRows) -> Tensor:
    """The rows of a layer from their definition, in float64."""
    rows = []
    for n in range(len(layer)):
        one = torch.ones(1, dtype=F64)
        matrix = torch.outer(layer.left[n].double(), torch.cat([layer.inputs[n].double(), one]))
        for right, tangents in layer.pairs:
            matrix = matrix + torch.outer(right[n].double(), torch.cat([tangents[n].double(), 0.0 * one]))
        rows.append(torch.cat([matrix[:, :-1].flatten(), matrix[:, -1]]))
    return torch.stack(rows) if rows else torch.zeros(0, layer.size, dtype=F64)


def layered(
    seed: int,
    rows: Sequence[tuple[int, int]] = ((9, 0), (14, 1), (1, 1), (5, 4)),
    widths: Sequence[int] = (3, 4, 1),
    units: Sequence[Sequence[int] | None] | None = None,
    stored: torch.dtype = F64,
) -> tuple[LayeredJacobian, Tensor]:
    """A Jacobian of blocks (rows, how many outer products beside the first) of a network, and its dense matrix.

    `units` chooses output units of each layer.
    """
    generator = torch.Generator().manual_seed(seed)
    blocks = []
    for count, pairs in rows:
        block = []
        for k, (into, out) in enumerate(pairwise(widths)):
            layer = layer_rows(generator, count, into, out, pairs).times(10.0 ** (-k) * torch.ones(count, dtype=F64))
            chosen = None if units is None else units[k]
            layer = layer if chosen is None else layer.into(torch.tensor(chosen, dtype=torch.long))
            block.append(layer.to(stored))
        blocks.append(block)
    sizes = tuple(layer.size for layer in blocks[0])
    total = sum(count for count, _ in rows)
    dense = torch.cat([torch.cat([multiplied_out(layer) for layer in block], 1) for block in blocks])
    return LayeredJacobian(lambda: blocks, total, sizes, torch.device("cpu")), dense


@dataclass(frozen=True)
class Problem:
    """J as an operator and as a float64 matrix, and r, of shape (M,)."""

    jacobian: Jacobian
    J: Tensor
    r: Tensor


def plain(J: Tensor, r: Tensor, stored: torch.dtype, groups: tuple[int, ...] | None = None) -> Problem:
    """A problem whose J is held as a matrix."""
    rounded = J.to(stored)
    return Problem(DenseJacobian(rounded, groups, chunk=7), rounded.double(), r.to(stored).double())


def tall(seed: int, stored: torch.dtype) -> Problem:
    """More rows than columns."""
    generator = torch.Generator().manual_seed(seed)
    return plain(randn(generator, 40, 11), randn(generator, 40), stored, (4, 0, 7))


def square(seed: int, stored: torch.dtype) -> Problem:
    """As many rows as columns."""
    generator = torch.Generator().manual_seed(seed)
    return plain(randn(generator, 12, 12), randn(generator, 12), stored)


def wide(seed: int, stored: torch.dtype) -> Problem:
    """Fewer rows than columns."""
    generator = torch.Generator().manual_seed(seed)
    return plain(randn(generator, 6, 25), randn(generator, 6), stored, (5, 20))


def badly_scaled(seed: int, stored: torch.dtype) -> Problem:
    """Columns whose lengths differ by three orders of magnitude."""
    generator = torch.Generator().manual_seed(seed)
    J = randn(generator, 30, 9) * 10.0 ** torch.linspace(-2, 1, 9, dtype=F64)
    return plain(J, randn(generator, 30), stored)


def duplicates(seed: int, stored: torch.dtype) -> Problem:
    """Three equal columns."""
    generator = torch.Generator().manual_seed(seed)
    J = randn(generator, 30, 8)
    J[:, 3] = J[:, 6] = J[:, 1]
    return plain(J, randn(generator, 30), stored)


def zero_column(seed: int, stored: torch.dtype) -> Problem:
    """A parameter that no residual sees."""
    generator = torch.Generator().manual_seed(seed)
    J = randn(generator, 30, 8)
    J[:, 5] = 0.0
    return plain(J, randn(generator, 30), stored)


def orthogonal(seed: int, stored: torch.dtype) -> Problem:
    """Residuals that no step lowers."""
    generator = torch.Generator().manual_seed(seed)
    J, r = randn(generator, 30, 8), randn(generator, 30)
    Q = torch.linalg.qr(J.to(stored).double()).Q
    return plain(J, r - Q @ (Q.T @ r), stored)


def network(seed: int, stored: torch.dtype) -> Problem:
    """Rows of values and of gradients, some units of a layer fixed."""
    jacobian, J = layered(seed, units=(None, (0,)), widths=(3, 4, 2), stored=stored)
    return Problem(jacobian, J, randn(torch.Generator().manual_seed(seed), len(J)))


def wide_network(seed: int, stored: torch.dtype) -> Problem:
    """Fewer rows than a network has parameters."""
    jacobian, J = layered(seed, ((4, True), (5, False)), (3, 5, 1), stored=stored)
    return Problem(jacobian, J, randn(torch.Generator().manual_seed(seed), len(J)))


PROBLEMS: dict[str, Callable[[int, torch.dtype], Problem]] = {
    make.__name__: make
    for make in (tall, square, wide, badly_scaled, duplicates, zero_column, orthogonal, network, wide_network)
}
