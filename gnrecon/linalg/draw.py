"""Some of J's rows, drawn so that they stand for all of them.

Rows drawn with probabilities q_n = min(1, c |j_n|^2), c such that m are expected, and divided by sqrt(q_n), give
J^T J = sum_n j_n j_n^T without bias. Long rows are certain to be drawn: the terms of a fit have weights that differ by
orders of magnitude, and the few heavy rows hold what the others do not.
Source: Drineas, Kannan, Mahoney, Fast Monte Carlo algorithms for matrices (2006).
"""

from __future__ import annotations

import torch
from torch import Tensor

from gnrecon.linalg.jacobian import Jacobian


def draw(jacobian: Jacobian, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Return about `count` < M of J's rows, ascending, of shape (m,), and by what to multiply each, of shape (m,)."""
    chances = inclusion(jacobian.row_squares(), count)
    # Drawn on the CPU, so that a seed means the same on every device.
    dice = torch.rand(jacobian.rows, generator=generator, dtype=torch.float64)
    drawn = (dice < chances.cpu()).nonzero()[:, 0].to(jacobian.device)
    return drawn, chances[drawn].rsqrt()


def inclusion(squares: Tensor, count: int) -> Tensor:
    """Return min(1, c s), of shape (M,), with c such that they sum to `count` < M, or all alike where s is zero."""
    squares = squares.double()
    if not float(squares.sum()) > 0.0:
        return torch.full_like(squares, count / len(squares))
    falling, order = squares.sort(descending=True)
    # Summed from the least on: differences of large sums would lose the short rows.
    rest = falling.flip(0).cumsum(0).flip(0)
    # With the k longest rows certain, c = (count - k) / (the rest's sum); right is the first k whose next row is not.
    certain = torch.arange(len(falling), dtype=falling.dtype, device=falling.device)
    c = (count - certain).clamp_min(0.0) / rest.clamp_min(torch.finfo(falling.dtype).tiny)
    first = int((c * falling <= 1.0).nonzero()[0])
    chances = torch.empty_like(squares)
    chances[order] = (c[first] * falling).clamp_max(1.0)
    chances[order[:first]] = 1.0
    return chances
