"""Preconditioning by sums of neighbouring rows, for rows that change little from one to the next.

The rows of one constraint, at points ordered so that successive points are close, are samples of a smooth function of
space. In a run of k of them the rows are nearly the same, j, and so

    sum over the run of j_n j_n^T  ~  k j j^T  ~  c c^T,    c = (sum of j_n) / sqrt(k).

The matrix C with one row c per run is the Jacobian of a quadrature that is k times as coarse. It has few rows, and the
push-through form (`direct.RowSpace`) solves with it in row space:

    (C^T C + mu D)^-1 r = D^-1/2 (q - E^T (E E^T + mu I)^-1 E q) / mu,    E = C D^-1/2,  q = D^-1/2 r.

C is summed from the outer products of J's rows without forming J (`LayerRows.write_runs`). It works well if few
eigenvalues of J^T J are above the damping, as on smooth surfaces. On the catenoid (2,800 rows, 1,217 parameters, 156
eigenvalues above the damping) conjugate gradients with 613 runs need one iteration to a relative error of 0.01 in the
norm of the damped matrix and 3 to 1e-4. A count sketch with as many sums needs 9 and 15, as many sampled rows 20 and
37.

If there are more runs than columns, C^T C itself is the preconditioner, at a quarter of the cost of J^T J on scans. If
neighbouring rows are not similar, it is a poor approximation, but still definite.

Source: aggregation in multigrid methods, such as Vanek, Mandel, Brezina, Algebraic multigrid by smoothed aggregation
(1996), applied to rows.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from gnrecon.least_squares.direct import solve_factored
from gnrecon.least_squares.jacobian import Jacobian
from gnrecon.least_squares.krylov import Apply
from gnrecon.least_squares.layer_products import gram
from gnrecon.least_squares.preconditioners import Prepared, PreparedGram, definite_factor


@dataclass(frozen=True)
class PreparedSums:
    """E = C D^-1/2, of shape (m, p), the lower triangle of E E^T, and D^-1/2's diagonal."""

    E: Tensor
    product: Tensor
    scale: Tensor

    def at(self, damping: float) -> Apply:
        """Return r -> (C^T C + damping D)^-1 r."""
        # The part outside the rows of C is a difference; its rounding error is divided by the damping.
        least = 100.0 * torch.finfo(self.product.dtype).eps * float(self.product.diagonal().sum())
        mu = max(damping, least, torch.finfo(self.product.dtype).tiny)
        factor = definite_factor(self.product, torch.full_like(self.product[0], mu))

        def apply(r: Tensor) -> Tensor:
            q = self.scale * r
            dual = solve_factored(factor, self.E @ q)
            return self.scale * (q - self.E.T @ dual) / mu

        return apply


@dataclass(frozen=True)
class NeighbourSums:
    """Sums of runs of m rows in all: O(M p + m^2 p) to set up, O(m^3) a damping; O(M p + m p^2) and O(p^3) if m > p.

    Parameters
    ----------
    least_cosine : least mean cosine between the first and the last row of a run; each constraint has the longest runs
        for which this holds, or single rows if none does
    longest : most rows of a run; the smaller the damping, the shorter runs should be
    refresh_interval : linearisations after which run lengths are computed again; rows change little in between
    """

    least_cosine: float = 0.7
    longest: int = 8
    refresh_interval: int = 8
    _found: list[list[int]] = field(default_factory=list, init=False, repr=False, compare=False)

    def prepare(self, jacobian: Jacobian, metric: Tensor, generator: torch.Generator) -> Prepared:  # noqa: ARG002
        """Choose the runs, sum them, and form E E^T or, if there are many runs, C^T C."""
        lengths = self._lengths(jacobian)
        runs = sum(-(-rows // length) for rows, length in zip(jacobian.constraint_rows, lengths, strict=True))
        if runs >= jacobian.columns:
            product = (
                jacobian.gram() if runs == jacobian.rows else gram(jacobian.run_sums(lengths), len(metric), metric)
            )
            return PreparedGram(product, metric, jacobian.stored)
        scale = metric.rsqrt()
        E = torch.cat([metric.new_zeros(0, len(metric)), *jacobian.run_sums(lengths)]).mul_(scale)
        return PreparedSums(E, gram([E.T], len(E), E), scale)

    def _lengths(self, jacobian: Jacobian) -> list[int]:
        """Return the lengths of the runs, cached ones if the number of constraints is the same."""
        if not self._found or len(self._found[-1]) != len(jacobian.constraint_rows):
            found = [min(length, self.longest) for length in run_lengths(jacobian, self.least_cosine)]
            self._found[:] = [found] * self.refresh_interval
        return self._found.pop()

    def describe(self) -> str:
        """Name it."""
        return "sums of neighbouring rows"


def run_lengths(
    jacobian: Jacobian, least_cosine: float, *, candidates: tuple[int, ...] = (2, 4, 8), samples: int = 8
) -> list[int]:
    """Return for each constraint the longest run whose first and last row are similar; see `NeighbourSums`.

    Parameters
    ----------
    candidates : lengths that are tried, ascending; powers of two from one
    samples : runs of a constraint over which the cosine is averaged
    """
    rows = torch.tensor(jacobian.constraint_rows, dtype=torch.long)
    long = rows >= candidates[-1]
    lengths = [1] * len(rows)
    if not bool(long.any()):
        return lengths
    firsts = torch.linspace(0, 1, samples) * (rows[long] - candidates[-1])[:, None]
    # The first row of each sampled run and the last row for each candidate length, of all constraint_rows at once.
    offsets = torch.tensor([0, *(length - 1 for length in candidates)])
    compared = ((rows.cumsum(0) - rows)[long, None] + firsts.long())[:, :, None] + offsets
    drawn, places = torch.unique(compared, return_inverse=True)
    found = torch.cat([chunk.clone() for chunk in jacobian.sample(drawn.to(jacobian.device)).dense()])
    first, *others = torch.nn.functional.normalize(found, dim=1)[places.to(found.device)].unbind(2)
    # Zero rows, of inactive constraints, have cosine zero with all others.
    cosines = torch.stack([(first * other).sum(2).mean(1) for other in others], 1).tolist()
    for number, values in zip(long.nonzero()[:, 0].tolist(), cosines, strict=True):
        similar = [length for length, cosine in zip(candidates, values, strict=True) if cosine >= least_cosine]
        lengths[number] = max([1, *similar])
    return lengths
