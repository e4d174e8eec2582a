"""Preconditioners approximate (J^T J + damping D)^-1: set up once from a Jacobian, then adapted to each damping.

Here what they share, and the two that keep only a part of J^T J near its diagonal: the diagonal itself (Jacobi), and
the diagonal blocks of the groups of columns, such as a network's layers (block Jacobi).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from gnrecon.least_squares.direct import damped_factor, solve_factored
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
        """Set up from J, of shape (M, p), not empty, and D's diagonal, of shape (p,); chance comes from `generator`."""
        ...

    def describe(self) -> str:
        """Return what it is, as a phrase that follows "preconditioned by"."""
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


@dataclass(frozen=True)
class PreparedBlocks:
    """Diagonal blocks of J^T J, lower triangles valid, for `groups` of columns."""

    products: Sequence[Tensor]
    groups: Sequence[slice]
    metric: Tensor

    def at(self, damping: float) -> Apply:
        """Return r -> P^-1 r with P block by block J_l^T J_l + damping D_l."""
        factors = [
            definite_factor(product, damping * self.metric[group])
            for product, group in zip(self.products, self.groups, strict=True)
        ]

        def apply(r: Tensor) -> Tensor:
            parts = zip(factors, self.groups, strict=True)
            return torch.cat([solve_factored(factor, r[group]) for factor, group in parts])

        return apply


@dataclass(frozen=True)
class BlockJacobi:
    """The groups' blocks of J^T J: O(M sum p_l^2) to set up, O(sum p_l^3) a damping."""

    def prepare(self, jacobian: Jacobian, metric: Tensor, generator: torch.Generator) -> PreparedBlocks:  # noqa: ARG002
        """Assemble the blocks."""
        return PreparedBlocks(jacobian.group_grams(), jacobian.groups, metric)

    def describe(self) -> str:
        """Name it."""
        return "the blocks of the groups of columns"


def positive(diagonal: Tensor) -> Tensor:
    """Return a diagonal with entries so small that they may be rounding raised to eps of the largest."""
    if not diagonal.numel():
        return diagonal
    largest = float(diagonal.max())
    return diagonal.clamp_min(torch.finfo(diagonal.dtype).eps * largest if largest > 0.0 else 1.0)


def definite_factor(product: Tensor, diagonal: Tensor) -> Tensor:
    """Return the lower Cholesky factor of `product` + diag(`diagonal`), shifted as little as makes it definite.

    A preconditioner may be off, but must be definite; rounding can leave small negative eigenvalues.
    """
    scale = positive(product.diagonal() + diagonal)
    for shift in (0.0, 1e-14, 1e-12, 1e-10, 1e-8, 1e-6, 1e-4, 1e-2):
        factor = damped_factor(product, diagonal + shift * scale)
        if factor is not None:
            return factor
    return torch.diag(scale.sqrt())


# Randomised Nystrom preconditioning: the leading eigenvectors of J^T J, found with a few products.
#
# With A = D^-1/2 J^T J D^-1/2 and a random orthonormal Omega of k columns, the sketch Y = A Omega gives the best
# approximation of A that Y knows of,
#
#     A ~ Y (Omega^T Y)^-1 Y^T = U diag(lambda) U^T,
#
# computed for A + nu I with a small shift nu, taken off again at the end, which keeps the Cholesky factor of Omega^T Y
# from breaking down in rounding. The preconditioner treats the part of A that U does not reach as lambda_k I:
#
#     P^-1 = U diag((lambda_k + mu) / (lambda + mu)) U^T + (I - U U^T),    mu = the damping,
#
# here divided by lambda_k + mu, so that it approximates the inverse itself. It serves where the eigenvalues of A fall
# below the damping within k of them. Source: Frangella, Tropp, Udell, Randomized Nystrom preconditioning (2021),
# algorithms 2.1 and equation 1.3.


@dataclass(frozen=True)
class PreparedNystrom:
    """U, of shape (p, k), lambda, of shape (k,) in descending order, and D^-1/2's diagonal."""

    U: Tensor
    values: Tensor
    scale: Tensor

    def at(self, damping: float) -> Apply:
        """Return r -> D^-1/2 P^-1 D^-1/2 r."""
        # The part outside of U comes from a difference, whose rounding, divided by `outside`, must not drown the rest.
        damped = positive(self.values + damping)
        damped = damped.clamp_min(100.0 * torch.finfo(damped.dtype).eps * float(damped[0]))
        outside = float(damped[-1])
        inner = 1.0 / damped - 1.0 / outside

        def apply(r: Tensor) -> Tensor:
            r = self.scale * r
            return self.scale * (r / outside + self.U @ (inner * (self.U.T @ r)))

        return apply


@dataclass(frozen=True)
class Nystrom:
    """The `rank` leading eigenvectors of J^T J in the metric: `rank` products with J^T J and O(p rank^2) to set up."""

    rank: int

    def prepare(self, jacobian: Jacobian, metric: Tensor, generator: torch.Generator) -> PreparedNystrom:
        """Sketch J^T J column by column."""
        p, k, scale = jacobian.columns, min(self.rank, jacobian.columns), metric.rsqrt()
        Omega = torch.linalg.qr(torch.randn(p, k, generator=generator, dtype=torch.float64).to(metric)).Q
        Y = torch.stack([scale * jacobian.tmv(jacobian.mv(scale * Omega[:, i])) for i in range(k)], 1)
        core = Omega.T @ Y
        # A shift of the size of what rounding left of the symmetry, at the least of eps |Y|
        asymmetry = float(torch.linalg.matrix_norm(core - core.T))
        nu = max(asymmetry, torch.finfo(Y.dtype).eps * float(torch.linalg.matrix_norm(Y)))
        Y = Y + nu * Omega
        # A + nu I ~ B B^T with B = Y C^-T and C C^T = Omega^T Y, so that B's singular values are sqrt(lambda + nu)
        C = definite_factor(0.5 * (core + core.T), torch.full_like(core[0], nu))
        B = torch.linalg.solve_triangular(C, Y.T, upper=False).T
        U, roots, _ = torch.linalg.svd(B, full_matrices=False)
        return PreparedNystrom(U, (roots.square() - nu).clamp_min(0.0), scale)

    def describe(self) -> str:
        """Name it."""
        return f"a Nystrom approximation of rank {self.rank}"


# Preconditioning by the Gram matrix of some of the rows, or of a sketch of all of them.
#
# Where M is several times p, J^T J = sum_n j_n j_n^T is a sum of many more terms than it has dimensions, and that of
# some rows, drawn by their lengths (see `linalg.draw`), is near it once they are a small multiple of p. Measured in the
# middle of a fit with 2,273 parameters and 21,636 rows, 4,500 of them drawn, at dampings of 1e-2, 1e-3 and 1e-4 of the
# layers' diagonals: 1, 2 and 5 iterations of conjugate gradients, instead of 15, 25 and 45 with equal chances for all
# rows.
#
# A count sketch needs no lengths: S adds every row, with a random sign, to one of m sums, and J^T S^T S J is near J^T J
# whatever J is.
#
# The products are made in the precision in which the rows are stored, and summed in that of the vectors. float32
# products lose what is below 1e-7 of J^T J's largest eigenvalue, and of a network's eigenvalues most are: with a
# damping of 2e-9 of the largest, 146 iterations instead of 17 (2,273 parameters, 19,400 rows, 4,546 drawn with equal
# chances), for half the time of set-up. Late in a fit, rows are therefore stored in float64. Sources: Avron,
# Maymounkov, Toledo, Blendenpik (2010), and Meng, Saunders, Mahoney, LSRN (2014), for least squares preconditioned by a
# sketch; Clarkson and Woodruff, Low-rank approximation and regression in input sparsity time (2013), for the count
# sketch; Roosta-Khorasani and Mahoney, Sub-sampled Newton methods (2016).


@dataclass(frozen=True)
class PreparedGram:
    """An approximation of J^T J, of shape (p, p), its lower triangle valid, and D's diagonal."""

    product: Tensor
    metric: Tensor

    def at(self, damping: float) -> Apply:
        """Return r -> (product + damping D)^-1 r."""
        factor = definite_factor(self.product, damping * self.metric)
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
        drawn, scales = draw(jacobian, self.rows, generator)
        return PreparedGram(gram(_scaled(jacobian.sample(drawn), scales), jacobian.columns, metric), metric)

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


# Some of J's rows, drawn so that they stand for all of them.
#
# Rows drawn with probabilities q_n = min(1, c |j_n|^2), c such that m are expected, and divided by sqrt(q_n), give J^T
# J = sum_n j_n j_n^T without bias. Long rows are certain to be drawn: the terms of a fit have weights that differ by
# orders of magnitude, and the few heavy rows hold what the others do not. Source: Drineas, Kannan, Mahoney, Fast Monte
# Carlo algorithms for matrices (2006).


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
