"""Preconditioning by sums of neighbouring rows, for rows that change little from one to the next.

The rows of one constraint, at points in an order along which neighbours lie close together, are samples of a smooth
function of space. In a run of k of them the rows are nearly the same, j, and so

    sum over the run of j_n j_n^T  ~  k j j^T  ~  c c^T,    c = (sum of j_n) / sqrt(k).

The matrix C of one c for each run is as if J had been made with a quadrature that is k times as coarse. It has few
rows, and the push-through form of `row_space` solves with it in their space:

    (C^T C + mu D)^-1 r = D^-1/2 (q - E^T (E E^T + mu I)^-1 E q) / mu,    E = C D^-1/2,  q = D^-1/2 r.

C is summed from the outer products of J's rows without J ever being formed (`LayerRows.write_runs`). Where few of
J^T J's eigenvalues are above the damping, as on smooth surfaces, this is all that conjugate gradients need: on the
catenoid (2,800 rows, 1,217 parameters, 156 eigenvalues above the damping) 613 runs make one iteration to an error of a
hundredth in the norm of the damped matrix and 3 to 1e-4, where as many sums of a count sketch make 9 and 15, and as
many drawn rows 20 and 37.

Where runs are more than columns, C^T C itself is the preconditioner, in which the scans of `shapes.scanned` spare three
quarters of J^T J. Where neighbours are not alike, it is a poor approximation, but still definite.

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

LENGTHS = (2, 4, 8)
"""Rows of a run, if it is more than one."""

ASKED = 8
"""Places in a constraint's rows at which neighbours are compared."""

AGAIN = 8
"""Linearisations after which they are compared again, as rows change little from one to the next."""


@dataclass(frozen=True)
class PreparedNeighbours:
    """E = C D^-1/2, of shape (m, p), the lower triangle of E E^T, and D^-1/2's diagonal."""

    E: Tensor
    product: Tensor
    scale: Tensor

    def at(self, damping: float) -> Apply:
        """Return r -> (C^T C + damping D)^-1 r."""
        # What C does not see comes from a difference, whose rounding, divided by the damping, must not drown the rest.
        least = 100.0 * torch.finfo(self.product.dtype).eps * float(self.product.diagonal().sum())
        mu = max(damping, least, torch.finfo(self.product.dtype).tiny)
        factor = definite_factor(self.product, torch.full_like(self.product[0], mu))

        def apply(r: Tensor) -> Tensor:
            q = self.scale * r
            dual = solve_factored(factor, self.E @ q)
            return self.scale * (q - self.E.T @ dual) / mu

        return apply


@dataclass(frozen=True)
class Neighbours:
    """Sums of runs of m rows in all: O(M p + m^2 p) to set up, O(m^3) a damping; O(M p + m p^2) and O(p^3) if m > p.

    Parameters
    ----------
    alike : least mean cosine of the angle between the first and the last row of a run. Each constraint has the longest
        runs that keep to it; of one that has none, each row counts by itself
    longest : most rows of a run: the smaller the damping, the shorter they should be
    """

    alike: float = 0.7
    longest: int = LENGTHS[-1]
    _found: list[list[int]] = field(default_factory=list, init=False, repr=False, compare=False)

    def prepare(self, jacobian: Jacobian, metric: Tensor, generator: torch.Generator) -> Prepared:  # noqa: ARG002
        """Choose the runs, sum them, and multiply them with one another or, where they are many, into C^T C."""
        lengths = self._lengths(jacobian)
        runs = sum(-(-rows // length) for rows, length in zip(jacobian.stretches, lengths, strict=True))
        if runs >= jacobian.columns:
            product = jacobian.gram() if runs == jacobian.rows else gram(jacobian.runs(lengths), len(metric), metric)
            return PreparedGram(product, metric)
        scale = metric.rsqrt()
        E = torch.cat([metric.new_zeros(0, len(metric)), *jacobian.runs(lengths)]).mul_(scale)
        return PreparedNeighbours(E, gram([E.T], len(E), E), scale)

    def _lengths(self, jacobian: Jacobian) -> list[int]:
        """Return the runs' lengths, those found of late where there are as many constraints."""
        if not self._found or len(self._found[-1]) != len(jacobian.stretches):
            found = [min(length, self.longest) for length in run_lengths(jacobian, self.alike)]
            self._found[:] = [found] * AGAIN
        return self._found.pop()

    def describe(self) -> str:
        """Name it."""
        return "sums of neighbouring rows"


def run_lengths(jacobian: Jacobian, alike: float) -> list[int]:
    """Return for each stretch of rows the longest run whose ends are so alike on the mean; see `Neighbours`."""
    rows = torch.tensor(jacobian.stretches, dtype=torch.long)
    long = rows >= LENGTHS[-1]
    lengths = [1] * len(rows)
    if not bool(long.any()):
        return lengths
    firsts = torch.linspace(0, 1, ASKED) * (rows[long] - LENGTHS[-1])[:, None]
    # Asked of all stretches at once, the runs' first rows and those that would be their last ones.
    offsets = torch.tensor([0, *(length - 1 for length in LENGTHS)])
    asked = ((rows.cumsum(0) - rows)[long, None] + firsts.long())[:, :, None] + offsets
    drawn, places = torch.unique(asked, return_inverse=True)
    found = torch.cat([chunk.clone() for chunk in jacobian.sample(drawn.to(jacobian.device)).dense()])
    first, *others = torch.nn.functional.normalize(found, dim=1)[places.to(found.device)].unbind(2)
    # Rows of zeros, of constraints that do not act, are alike to nothing.
    cosines = torch.stack([(first * other).sum(2).mean(1) for other in others], 1).tolist()
    for stretch, of in zip(long.nonzero()[:, 0].tolist(), cosines, strict=True):
        lengths[stretch] = max([1, *(length for length, cosine in zip(LENGTHS, of, strict=True) if cosine >= alike)])
    return lengths
