"""Preconditioners approximate (J^T J + damping D)^-1: set up once from a Jacobian, then adapted to each damping.

Here are the two protocols, the diagonal (Jacobi), and the Gram matrix of sampled rows or of a count sketch. Others:
`kronecker`, `neighbour_sums` and `paper_solvers`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from gnrecon.least_squares.direct import damped_factor, rounded_factor, solve_factored
from gnrecon.least_squares.jacobian import Jacobian
from gnrecon.least_squares.krylov import Apply
from gnrecon.least_squares.layer_products import gram


class Prepared(Protocol):
    """A preconditioner of one Jacobian in one metric."""

    def at(self, damping: float) -> Apply:
        """Return r -> P^-1 r, symmetric and positive definite, for P near J^T J + damping D."""
        ...


class Preconditioner(Protocol):
    """A way of approximating J^T J."""

    def prepare(self, jacobian: Jacobian, metric: Tensor, generator: torch.Generator) -> Prepared:
        """Set up from J, of shape (M, p), not empty, and D's diagonal, of shape (p,)."""
        ...

    def describe(self) -> str:
        """Return its name, as a phrase to follow "preconditioned by"."""
        ...


@dataclass(frozen=True)
class PreparedDiagonal:
    """The diagonals of J^T J and of D, of shape (p,)."""

    diagonal: Tensor
    metric: Tensor

    def at(self, damping: float) -> Apply:
        """Return r -> r / (diagonal + damping D)."""
        inverse = 1.0 / positive(self.diagonal + damping * self.metric)
        return lambda r: inverse * r


@dataclass(frozen=True)
class Jacobi:
    """The diagonal of J^T J + damping D: O(M p / width) to set up from layers, no memory."""

    def prepare(self, jacobian: Jacobian, metric: Tensor, generator: torch.Generator) -> PreparedDiagonal:  # noqa: ARG002
        """Take the diagonal."""
        return PreparedDiagonal(jacobian.diagonal(), metric)

    def describe(self) -> str:
        """Name it."""
        return "the diagonal"


def positive(diagonal: Tensor) -> Tensor:
    """Return a diagonal with entries so small that they may be rounding raised to eps of the largest."""
    if not diagonal.numel():
        return diagonal
    largest = float(diagonal.max())
    return diagonal.clamp_min(torch.finfo(diagonal.dtype).eps * largest if largest > 0.0 else 1.0)


def definite_factor(product: Tensor, diagonal: Tensor) -> Tensor:
    """Return the lower Cholesky factor of `product` + diag(`diagonal`), with the smallest shift that makes it definite.

    A preconditioner need not be accurate but must be definite; rounding can leave small negative eigenvalues.
    """
    scale = positive(product.diagonal() + diagonal)
    for shift in (0.0, 1e-14, 1e-12, 1e-10, 1e-8, 1e-6, 1e-4, 1e-2):
        factor = damped_factor(product, diagonal + shift * scale)
        if factor is not None:
            return factor
    return torch.diag(scale.sqrt())


# Preconditioning by the Gram matrix of some of the rows, or of a sketch of all rows.
#
# Where M is several times p, J^T J = sum_n j_n j_n^T has many more terms than dimensions. A sample of a small multiple
# of p rows, drawn by length (see `draw_rows`), approximates it. Measured in the middle of a fit with 2,273 parameters
# and 21,636 rows, 4,500 of them drawn, at dampings of 1e-2, 1e-3 and 1e-4 of the layers' diagonals: 1, 2 and 5
# iterations of conjugate gradients, against 15, 25 and 45 with uniform sampling.
#
# A count sketch needs no lengths: S adds every row, with a random sign, to one of m sums, and J^T S^T S J approximates
# J^T J for every J.
#
# Products are computed and, of sampled rows, summed in the storage precision of the rows; sums of all rows have that
# of the vectors. float32 products lose eigenvalues below 1e-7 of the largest one, which are most of a network's: with
# a damping of 2e-9 of the largest, 146 iterations instead of 17 (2,273 parameters, 19,400 rows, 4,546 drawn uniformly),
# at half the set-up time. Late in a fit, rows are therefore stored in float64. Sources: Avron, Maymounkov, Toledo,
# Blendenpik (2010), and Meng, Saunders, Mahoney, LSRN (2014), for least squares preconditioned by a sketch; Clarkson
# and Woodruff, Low-rank approximation and regression in input sparsity time (2013), for the count sketch;
# Roosta-Khorasani and Mahoney, Sub-sampled Newton methods (2016).


@dataclass(frozen=True)
class PreparedGram:
    """An approximation of J^T J, of shape (p, p), its lower triangle valid, D's diagonal, and the precision of J."""

    product: Tensor
    metric: Tensor
    stored: torch.dtype = torch.float64

    def at(self, damping: float) -> Apply:
        """Return r -> (product + damping D)^-1 r, in single precision where J has it and the damping hides that."""
        diagonal = damping * self.metric
        rounded = rounded_factor(self.product, diagonal, self.stored)
        factor = definite_factor(self.product.to(diagonal), diagonal) if rounded is None else rounded
        return lambda r: solve_factored(factor, r)


@dataclass(frozen=True)
class SampledGram:
    """J^T J from `rows` of the M rows, at least a small multiple of p: O(rows p^2) to set up, O(p^3) a damping."""

    rows: int

    def prepare(self, jacobian: Jacobian, metric: Tensor, generator: torch.Generator) -> PreparedGram:
        """Draw rows and assemble their Gram matrix."""
        if self.rows >= jacobian.rows:
            return PreparedGram(
                gram((chunk.to(metric) for chunk in jacobian.dense()), jacobian.columns, metric), metric
            )
        drawn, scales = draw_rows(jacobian, self.rows, generator)
        # In the precision of the rows, in which few products are summed: it only has to be near J^T J.
        like = metric.to(jacobian.stored)
        product = gram(_scaled(jacobian.sample(drawn), scales), jacobian.columns, like)
        return PreparedGram(product, metric, jacobian.stored)

    def describe(self) -> str:
        """Name it."""
        return f"the Gram matrix of {self.rows:,} sampled rows"


def _scaled(jacobian: Jacobian, scales: Tensor) -> Iterator[Tensor]:
    """Yield chunks of rows, each row times its scale."""
    start = 0
    for chunk in jacobian.dense():
        stop = start + len(chunk)
        yield chunk.mul_(scales[start:stop, None].to(chunk))
        start = stop


@dataclass(frozen=True)
class Sketch:
    """J^T S^T S J for a count sketch S of `factor` * p rows: O(M p + factor p^3) to set up, O(p^3) a damping."""

    factor: float = 4.0

    def prepare(self, jacobian: Jacobian, metric: Tensor, generator: torch.Generator) -> PreparedGram:
        """Sketch J, or take all of it where the sketch would not be smaller."""
        height = max(1, round(self.factor * jacobian.columns))
        if height >= jacobian.rows:
            return PreparedGram(jacobian.gram(), metric)
        sums = torch.randint(height, (jacobian.rows,), generator=generator).to(jacobian.device)
        signs = torch.randint(2, (jacobian.rows,), generator=generator).to(jacobian.device) * 2 - 1
        sketch, start = metric.new_zeros(height, jacobian.columns), 0
        for chunk in jacobian.dense():
            stop = start + len(chunk)
            sketch.index_add_(0, sums[start:stop], (chunk * signs[start:stop, None]).to(sketch.dtype))
            start = stop
        return PreparedGram(gram([sketch], jacobian.columns, metric), metric)

    def describe(self) -> str:
        """Name it."""
        return f"a sketch of the rows of {self.factor:g} times as many as parameters"


# Random row sampling by squared length.
#
# Rows drawn with probabilities q_n = min(1, c |j_n|^2), with c such that m are expected, and divided by sqrt(q_n), give
# an unbiased estimate of J^T J = sum_n j_n j_n^T. Long rows are always drawn: the weights of a fit's terms differ by
# orders of magnitude, and the few heavy rows carry information that no other row has. Source: Drineas, Kannan,
# Mahoney, Fast Monte Carlo algorithms for matrices (2006).


def draw_rows(jacobian: Jacobian, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Return about `count` < M of J's rows, ascending, of shape (m,), and the factor of each, of shape (m,)."""
    chances = inclusion_probabilities(jacobian.row_squares(), count)
    # Drawn on the CPU, so that a seed gives the same rows on every device.
    dice = torch.rand(jacobian.rows, generator=generator, dtype=torch.float64)
    drawn = (dice < chances.cpu()).nonzero()[:, 0].to(jacobian.device)
    return drawn, chances[drawn].rsqrt()


def inclusion_probabilities(squares: Tensor, count: int) -> Tensor:
    """Return min(1, c s), of shape (M,), with c such that they sum to `count` < M; all equal if s is zero."""
    squares = squares.double()
    if not float(squares.sum()) > 0.0:
        return torch.full_like(squares, count / len(squares))
    falling, order = squares.sort(descending=True)
    # Summed from the smallest on: differences of large sums would lose the short rows.
    rest = falling.flip(0).cumsum(0).flip(0)
    # With the k longest rows certain, c = (count - k) / (sum of the others); take the first k for which c s <= 1.
    certain = torch.arange(len(falling), dtype=falling.dtype, device=falling.device)
    c = (count - certain).clamp_min(0.0) / rest.clamp_min(torch.finfo(falling.dtype).tiny)
    first = int((c * falling <= 1.0).nonzero()[0])
    chances = torch.empty_like(squares)
    chances[order] = (c[first] * falling).clamp_max(1.0)
    chances[order[:first]] = 1.0
    return chances
