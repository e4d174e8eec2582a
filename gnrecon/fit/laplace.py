"""The Laplace approximation of a fit: a normal distribution of the parameters about the solution.

With the rows J of the data, weighted as in the fit, their noise s, and a weak prior of precision L, the free parameters
have the covariance

    C = (J^T J / s^2 + L)^-1,

which is exact where the field is linear in them, as in its last layer. Source: MacKay, A Practical Bayesian Framework
for Backpropagation Networks (1992).

*Noise.* s^2 = |r|^2 / (M - g), the residuals at the mode over the rows that are left when the parameters have taken
theirs: g = tr(C J^T J) / s^2. What the features cannot follow counts as noise. The formula is applied until s settles.
The plain mean square would be too small, because these networks nearly interpolate; but the noise is not less than
that, because a fit that leaves residuals which the data alone would not ask for is no better than they are.

*Prior.* Within each layer one variance for all parameters, such that they move f at the data by `PRIOR` radii in the
root mean square: the fit's own ridge is as weak. The output weights have mean zero, all others stay where they are.

The coarse distances of the volume are left out. Their errors are alike over whole regions, and taken as independent
they make the field look certain in the middle of holes (docs/uncertainty.md).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gnrecon.fit.data_rows import DataRows
from gnrecon.least_squares import LayeredJacobian
from gnrecon.least_squares.direct import damped_factor, solve_factored
from gnrecon.runtime.errors import FitError

PRIOR = 10.0
PASSES, SETTLED = 6, 0.02

LEAST_NOISE = 1e-5
"""In radii; below it rounding would decide."""

ATTEMPTS, GROWTH = 6, 3.0
"""How often, and by what factor, noise is raised where rounding makes C^-1 indefinite all the same."""


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
class _Evidence:
    """J and r at the fitted parameters, J^T J (its lower triangle), J^T r, L, and the way from the prior's mean."""

    jacobian: LayeredJacobian
    residual: Tensor
    product: Tensor
    gradient: Tensor
    prior: Tensor
    offset: Tensor


def laplace(data: DataRows) -> Laplace:
    """Return the distribution of the parameters that data points leave.

    Raises
    ------
    FitError
        When the matrix of the data cannot be factored.
    """
    jacobian, residual = data.linearise()
    evidence = _Evidence(jacobian, residual, jacobian.gram(), jacobian.tmv(residual), *_prior(data, jacobian))
    least = max(float(residual.square().mean()) ** 0.5, LEAST_NOISE)
    noise = least
    for _ in range(PASSES):
        before, noise = noise, max(_noise(evidence, _at(evidence, noise)), least)
        if abs(noise / before - 1) < SETTLED:
            break
    return _at(evidence, noise)


def _prior(data: DataRows, jacobian: LayeredJacobian) -> tuple[Tensor, Tensor]:
    """Return L and how far the fitted parameters lie from the prior's mean, both of shape (p,)."""
    squares = data.values(data.points).diagonal() / len(data)
    precision, offset = torch.empty_like(squares), torch.zeros_like(squares)
    for group in jacobian.groups:
        precision[group] = squares[group].sum().clamp_min(torch.finfo(squares.dtype).tiny) / PRIOR**2
    output = jacobian.groups[-1]
    offset[output] = data.theta[output.start - output.stop :]
    return precision, offset


def _at(evidence: _Evidence, noise: float) -> Laplace:
    """Return the distribution for a noise, or for a larger one where rounding asks for it."""
    for _ in range(ATTEMPTS):
        factor = damped_factor(evidence.product / noise**2, evidence.prior)
        if factor is not None:
            slope = evidence.gradient / noise**2 + evidence.prior * evidence.offset
            return Laplace(factor, noise, -solve_factored(factor, slope))
        noise *= GROWTH
    raise FitError("The uncertainty is not available: the matrix of the data has no Cholesky factor.")


def _noise(evidence: _Evidence, posterior: Laplace) -> float:
    """Return the noise from the residuals at the mode and the rows that remain for it."""
    covariance = torch.cholesky_inverse(posterior.factor).tril()
    # Halved, so that twice the sum over lower triangles is the trace of the product.
    covariance.diagonal().div_(2)
    taken = 2 * float((covariance * evidence.product).sum()) / posterior.noise**2
    squares = float((evidence.residual + evidence.jacobian.mv(posterior.shift)).square().sum())
    return float((squares / max(len(evidence.residual) - taken, 1.0)) ** 0.5)
