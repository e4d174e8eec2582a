"""The rows of the data in a fit's Jacobian, for what is asked of a fit once it is done.

One interface row (f = 0) and the rows of the normal's residual a point, weighted as in the fit (`loss`), so that
residuals are positions in radii. Their columns are the free parameters: all of a network of up to `MOST_PARAMETERS` of
them; of a larger one the last layer and, where that is narrow, as many evenly spaced units of the layers before it as
there is room for. The features of a wide last layer span the field by themselves: the uncertainty is the same with all
parameters (docs/uncertainty.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gnrecon.field.networks import Siren
from gnrecon.fit.problem import FieldProblem
from gnrecon.fit.terms import Term
from gnrecon.least_squares import LayeredJacobian
from gnrecon.residuals.constraints import Residual, interface

MOST_PARAMETERS = 3000
WIDE = 600
"""Units of a last layer that spans the field by itself."""

KEPT_BYTES = 200_000_000


@dataclass(frozen=True)
class DataRows:
    """Rows of data points.

    Parameters
    ----------
    field : Siren
    theta : all parameters, of shape (p,)
    points, normals : of shape (N, 3), unit coordinates
    normal_residual : the fit's residual of the normals
    normal_weight : of its square beside that of the interface
    """

    field: Siren
    theta: Tensor
    points: Tensor
    normals: Tensor
    normal_residual: Residual
    normal_weight: float

    def __len__(self) -> int:
        return len(self.points)

    def linearise(self, rows: Tensor | None = None) -> tuple[LayeredJacobian, Tensor]:
        """Return J in the free parameters, and r, at some of the points or all; of few points, interface rows first."""
        points, normals = (self.points, self.normals) if rows is None else (self.points[rows], self.normals[rows])
        # The fit's terms are means over their points; here each row counts as it is.
        count = float(len(points))
        normal = Term("normal", self.normal_residual, points, normals, count * self.normal_weight)
        return self._linearise([Term("interface", interface, points, None, count), normal])

    def values(self, points: Tensor) -> LayeredJacobian:
        """Return the derivatives of f at points, of shape (N, 3), by the free parameters."""
        return self._linearise([Term("value", interface, points, None, float(len(points)))])[0]

    def _linearise(self, terms: Sequence[Term]) -> tuple[LayeredJacobian, Tensor]:
        units = free_units(self.field, self.theta.device)
        problem = FieldProblem(self.field, terms, self.theta, units, keep_bytes=KEPT_BYTES)
        return problem.linearise(problem.free())


def free_units(field: Siren, device: torch.device) -> tuple[Tensor | None, ...] | None:
    """Return which units of each layer are free, or None where all parameters are."""
    if field.widths[-1] < WIDE and field.layout.count <= MOST_PARAMETERS:
        return None
    room = MOST_PARAMETERS - field.widths[-1] - 1 if field.widths[-1] < WIDE else 0
    of_each = max(room, 0) // sum(into + 1 for _, into in field.layout.shapes[:-1])
    counts = [min(of_each, width) for width in field.widths]
    hidden = [
        torch.arange(count, device=device) * width // max(count, 1)
        for count, width in zip(counts, field.widths, strict=True)
    ]
    return (*hidden, None)
