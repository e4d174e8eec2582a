"""Preconditioning by the Gram matrix of some of the rows, or of a sketch of all of them.

Where M is several times p, J^T J = sum_n j_n j_n^T is a sum of many more terms than it has dimensions. The average
over m rows drawn without replacement,  (M / m) sum_sampled j_n j_n^T,  is near it once m is a small multiple of p,
unless a few rows hold what the others do not. A count sketch is proof against such rows: S adds every row, with a
random sign, to one of m sums, and J^T S^T S J is near J^T J whatever J is. The products may run in float32, which is
twice as fast, because a preconditioner only has to be near: what is lost is below about 1e-7 of J^T J's largest
eigenvalue. Its factorisation is in the precision of the vectors. Sources: Avron, Maymounkov, Toledo, Blendenpik
(2010), and Meng, Saunders, Mahoney, LSRN (2014), for least squares preconditioned by a sketch; Clarkson and Woodruff,
Low-rank approximation and regression in input sparsity time (2013), for the count sketch; Roosta-Khorasani and
Mahoney, Sub-sampled Newton methods (2016), for sampled rows.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gnrecon.linalg.cholesky import solve_factored
from gnrecon.linalg.gram import gram
from gnrecon.linalg.jacobian import Jacobian
from gnrecon.linalg.krylov import Apply
from gnrecon.linalg.preconditioner import definite_factor


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
    """J^T J from `rows` of the M rows: O(rows p^2) to set up, O(p^3) a damping, O(p^2) an application.

    Parameters
    ----------
    rows : how many, at least a small multiple of p
    products : precision in which the rows are multiplied
    """

    rows: int
    products: torch.dtype = torch.float32

    def prepare(self, jacobian: Jacobian, metric: Tensor, generator: torch.Generator) -> PreparedGram:
        """Draw rows and assemble their Gram matrix."""
        chosen, scale = jacobian, 1.0
        if self.rows < jacobian.rows:
            # In ascending order and with the same chance for all, so that blocks of rows are drawn from in proportion.
            drawn = torch.randperm(jacobian.rows, generator=generator)[: self.rows].sort().values
            chosen, scale = jacobian.sample(drawn.to(jacobian.device)), jacobian.rows / self.rows
        chunks = (chunk.to(self.products) for chunk in chosen.dense())
        return PreparedGram(gram(chunks, jacobian.columns, metric).mul_(scale), metric)

    def describe(self) -> str:
        """Name it."""
        return f"the Gram matrix of {self.rows:,} sampled rows"


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
