"""Terms of a fit: a residual, where it is sampled, and its weight."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from gnrecon.residuals.constraints import Residual


@dataclass(frozen=True)
class Term:
    """One constraint on one frozen set of points.

    The loss is  weight / (2 N) sum_i |r_i|^2  over the term's N points, the paper's Monte Carlo quadrature.

    Parameters
    ----------
    name : str
        What the history and the report call it.
    residual : function of (value, gradient, target)
    points : of shape (N, 3), unit coordinates
    target : of shape (N,) or (N, 3), or None
    weight : float, or a tensor of shape (N,) for weights that differ from point to point
    """

    name: str
    residual: Residual
    points: Tensor
    target: Tensor | None = None
    weight: float | Tensor = 1.0

    def __len__(self) -> int:
        return len(self.points)


def groups(terms: Sequence[Term]) -> list[list[Term]]:
    """Gather the terms that share one tensor of points, so that the network is differentiated once for all of them."""
    by_points: dict[int, list[Term]] = {}
    for term in terms:
        by_points.setdefault(id(term.points), []).append(term)
    return list(by_points.values())
