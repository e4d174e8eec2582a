"""The rows of the data in a fit's Jacobian, for what is asked of a fit once it is done.

One interface row (f = 0) and the rows of the normal's residual a point, unweighted, in the free parameters alone:
all of a network of up to `MOST_PARAMETERS` of them; of a larger one the last layer and, where that is narrow, as many
evenly spaced units of the layers before it as there is room for. The features of a wide last layer span the field by
themselves: the uncertainty is then the same with all parameters (docs/uncertainty.md).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gnrecon.field.siren import Siren
from gnrecon.fit.problem import FieldProblem
from gnrecon.fit.terms import Term
from gnrecon.linalg import LayeredJacobian
from gnrecon.residuals.first_order import Residual, interface

MOST_PARAMETERS = 3000
WIDE = 600
"""Units of a last layer that spans the field by itself."""


@dataclass(frozen=True)
class DataRows:
    """Rows of data points.

    Parameters
    ----------
    field : Siren
    theta : all parameters, of shape (p,)
    points, normals : of shape (N, 3), unit coordinates
    normal_residual : the fit's residual of the normals
    """

    field: Siren
    theta: Tensor
    points: Tensor
    normals: Tensor
    normal_residual: Residual

    def __len__(self) -> int:
        return len(self.points)

    def terms(self, rows: Tensor) -> tuple[Term, Term]:
        """Return interface and normals at some of the points, weighted so that each row counts as it is."""
        points, count = self.points[rows], float(len(rows))
        return (
            Term("interface", interface, points, None, count),
            Term("normal", self.normal_residual, points, self.normals[rows], count),
        )

    def linearise(self, term: Term) -> tuple[LayeredJacobian, Tensor]:
        """Return a term's J in the free parameters and its residuals r."""
        problem = FieldProblem(self.field, [term], self.theta, free_units(self.field, self.theta.device))
        return problem.linearise(problem.free())

    def values(self, points: Tensor) -> LayeredJacobian:
        """Return the derivatives of f at points, of shape (N, 3), by the free parameters."""
        return self.linearise(Term("value", interface, points, None, float(len(points))))[0]


def free_units(field: Siren, device: torch.device) -> tuple[Tensor | None, ...] | None:
    """Return which units of each layer are free, or None where all parameters are."""
    if field.widths[-1] < WIDE and field.layout.count <= MOST_PARAMETERS:
        return None
    room = MOST_PARAMETERS - field.widths[-1] - 1 if field.widths[-1] < WIDE else 0
    of_each = max(room, 0) // sum(into + 1 for _, into in field.layout.shapes[:-1])
    hidden = [torch.arange(min(of_each, width), device=device) * width // max(of_each, 1) for width in field.widths]
    return (*(units.unique() for units in hidden), None)
