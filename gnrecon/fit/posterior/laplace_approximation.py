"""The Laplace approximation of a fit: a normal distribution of the parameters about the solution.

With the rows J of the data, weighted as in the fit, their noise s, and a weak prior of precision L, the free parameters
have the covariance

    C = (J^T J / s^2 + L)^-1,

which is exact where the field is linear in them, as in its last layer. Source: MacKay, A Practical Bayesian Framework
for Backpropagation Networks (1992).

*Noise.* s^2 = |r|^2 / (M - g), the residuals at the mode over the rows that are left when the parameters have taken
theirs: g = tr(C J^T J) / s^2. What the features cannot follow counts as noise. The formula is applied until s settles.
The plain mean square would be too small, because these networks nearly interpolate; but the noise is not less than
that: a fit cannot be more accurate than its residuals.

*Prior.* Within each layer one variance for all parameters, such that they move f at the data by 10 radii in the
root mean square: the fit's own ridge is as weak. The output weights have mean zero, all others stay where they are.

The coarse distances of the volume are left out. Their errors are correlated over whole regions; taken as independent,
they make the field look certain in the middle of holes (docs/research/2026-11-21-uncertainty-models.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gnrecon.field.networks import Siren
from gnrecon.fit.objective import FieldProblem, ObjectiveTerm
from gnrecon.fit.parameters import LaplaceParameters
from gnrecon.least_squares import LayeredJacobian
from gnrecon.least_squares.direct import damped_factor, solve_factored
from gnrecon.residuals.constraints import Residual, interface
from gnrecon.runtime.errors import FitError


@dataclass(frozen=True)
class Laplace:
    """A normal distribution of the free parameters.

    Parameters
    ----------
    factor : lower Cholesky factor of C^-1, of shape (p, p)
    noise : s, in radii
    shift : from the fitted parameters to the mode, of shape (p,)
    """

    factor: Tensor
    noise: float
    shift: Tensor

    def whitener(self) -> Tensor:
        """Return W, of shape (p, p), with C = W^T W, so that |W j| is the standard deviation of j . theta."""
        identity = torch.eye(len(self.factor), dtype=self.factor.dtype, device=self.factor.device)
        inverse: Tensor = torch.linalg.solve_triangular(self.factor, identity, upper=False)
        return inverse


@dataclass(frozen=True)
class _NormalEquations:
    """J and r at the fitted parameters, J^T J (its lower triangle), J^T r, L, and the way from the prior's mean."""

    jacobian: LayeredJacobian
    residual: Tensor
    product: Tensor
    gradient: Tensor
    prior: Tensor
    offset: Tensor


def laplace(data: DataRows, *, parameters: LaplaceParameters = LaplaceParameters()) -> Laplace:
    """Return the distribution of the parameters that data points leave.

    Raises
    ------
    FitError
        When the matrix of the data cannot be factored.
    """
    jacobian, residual = data.linearise()
    prior = _prior(data, jacobian, parameters.prior_deviation_radii)
    equations = _NormalEquations(jacobian, residual, jacobian.gram(), jacobian.tmv(residual), *prior)
    least = max(float(residual.square().mean()) ** 0.5, parameters.least_noise_radii)
    noise = least
    for _ in range(parameters.noise_passes):
        before, noise = noise, max(_noise(equations, _at(equations, noise, parameters)), least)
        if abs(noise / before - 1) < parameters.noise_tolerance:
            break
    return _at(equations, noise, parameters)


def _prior(data: DataRows, jacobian: LayeredJacobian, deviation: float) -> tuple[Tensor, Tensor]:
    """Return L and how far the fitted parameters lie from the prior's mean, both of shape (p,)."""
    squares = data.values(data.points).diagonal() / len(data)
    precision, offset = torch.empty_like(squares), torch.zeros_like(squares)
    for group in jacobian.groups:
        precision[group] = squares[group].sum().clamp_min(torch.finfo(squares.dtype).tiny) / deviation**2
    output = jacobian.groups[-1]
    offset[output] = data.theta[output.start - output.stop :]
    return precision, offset


def _at(equations: _NormalEquations, noise: float, parameters: LaplaceParameters) -> Laplace:
    """Return the distribution for a noise, or for a larger one where rounding makes C^-1 indefinite."""
    for _ in range(parameters.noise_attempts):
        factor = damped_factor(equations.product / noise**2, equations.prior)
        if factor is not None:
            slope = equations.gradient / noise**2 + equations.prior * equations.offset
            return Laplace(factor, noise, -solve_factored(factor, slope))
        noise *= parameters.noise_growth
    raise FitError("The uncertainty is not available: the matrix of the data has no Cholesky factor.")


def _noise(equations: _NormalEquations, posterior: Laplace) -> float:
    """Return the noise from the residuals at the mode and the rows that remain for it."""
    covariance = torch.cholesky_inverse(posterior.factor).tril()
    # Halved, so that twice the sum over lower triangles is the trace of the product.
    covariance.diagonal().div_(2)
    taken = 2 * float((covariance * equations.product).sum()) / posterior.noise**2
    squares = float((equations.residual + equations.jacobian.mv(posterior.shift)).square().sum())
    return float((squares / max(len(equations.residual) - taken, 1.0)) ** 0.5)


# The rows of the data in a fit's Jacobian.
#
# One interface row (f = 0) and the rows of the normal's residual a point, weighted as in the fit (`loss`), so that
# residuals are positions in radii. Their columns are the free parameters: all of a network of up to 3,000
# of them; of a larger one the last layer and, where that is narrow, as many evenly spaced units of the layers before it
# as there is room for. The features of a wide last layer span the field by themselves: the uncertainty is the same with
# all parameters (docs/research/2026-11-21-uncertainty-models.md).


@dataclass(frozen=True)
class DataRows:
    """Rows of data points.

    Parameters
    ----------
    field : Siren
    theta : all parameters, of shape (p,)
    points, normals : of shape (N, 3), unit coordinates
    normal_residual : the fit's residual of the normals
    normal_weight : of its square, relative to that of the interface
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
        normal = ObjectiveTerm("normal", self.normal_residual, points, normals, count * self.normal_weight)
        return self._linearise([ObjectiveTerm("interface", interface, points, None, count), normal])

    def values(self, points: Tensor) -> LayeredJacobian:
        """Return the derivatives of f at points, of shape (N, 3), by the free parameters."""
        return self._linearise([ObjectiveTerm("value", interface, points, None, float(len(points)))])[0]

    def _linearise(self, terms: Sequence[ObjectiveTerm]) -> tuple[LayeredJacobian, Tensor]:
        units = free_units(self.field, self.theta.device)
        problem = FieldProblem(self.field, terms, self.theta, units, keep_bytes=LaplaceParameters.factor_bytes)
        return problem.linearise(problem.free())


def free_units(
    field: Siren, device: torch.device, *, parameters: LaplaceParameters = LaplaceParameters()
) -> tuple[Tensor | None, ...] | None:
    """Return which units of each layer are free, or None where all parameters are."""
    narrow = field.widths[-1] < parameters.wide_units
    if narrow and field.layout.count <= parameters.most_free_parameters:
        return None
    room = parameters.most_free_parameters - field.widths[-1] - 1 if narrow else 0
    of_each = max(room, 0) // sum(into + 1 for _, into in field.layout.shapes[:-1])
    counts = [min(of_each, width) for width in field.widths]
    hidden = [
        torch.arange(count, device=device) * width // max(count, 1)
        for count, width in zip(counts, field.widths, strict=True)
    ]
    return (*hidden, None)
