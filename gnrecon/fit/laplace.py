"""The Laplace approximation of a fit: a normal distribution of the parameters about the solution.

With rows J_t of the term t (interface, normals), their noise s_t, and a weak prior of precision L, the free parameters
have the covariance

    C = (sum_t J_t^T J_t / s_t^2 + L)^-1,

which is exact where the field is linear in them, as in its last layer. Source: MacKay, A Practical Bayesian Framework
for Backpropagation Networks (1992).

*Noise.* s_t^2 = |r_t|^2 / (M_t - g_t), the residuals at the mode over the rows that are left when the parameters have
taken theirs: g_t = tr(C J_t^T J_t) / s_t^2. What the features cannot follow counts as noise. The formula is applied
until s_t settles. Plain mean squares would be several times too small, because these networks nearly interpolate.

*Prior.* Within each layer one variance for all parameters, such that they move f at the data by `PRIOR` radii in the
root mean square: the fit's own ridge is as weak. The output weights have mean zero, all others stay where they are.

The coarse distances of the volume are left out. Their errors are alike over whole regions, and taken as independent
they make the field look certain in the middle of holes (docs/uncertainty.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from gnrecon.errors import FitError
from gnrecon.fit.data_rows import DataRows
from gnrecon.linalg import LayeredJacobian
from gnrecon.linalg.cholesky import damped_factor

PRIOR = 10.0
LEAST_NOISE = (1e-5, 1e-3)
"""Noise of positions, in radii, and of normals below which rounding would decide."""

PASSES, SETTLED = 4, 0.05


@dataclass(frozen=True)
class Evidence:
    """What a term tells of the parameters: J and r, J^T J (its lower triangle) and J^T r."""

    jacobian: LayeredJacobian
    residual: Tensor
    product: Tensor
    gradient: Tensor

    @classmethod
    def of(cls, jacobian: LayeredJacobian, residual: Tensor) -> Evidence:
        """Assemble J^T J and J^T r."""
        return cls(jacobian, residual, jacobian.gram(), jacobian.tmv(residual))

    def residual_at(self, shift: Tensor) -> Tensor:
        """Return r + J s, of shape (M,)."""
        return self.residual + self.jacobian.mv(shift)


@dataclass(frozen=True)
class Laplace:
    """A normal distribution of the free parameters.

    Parameters
    ----------
    factor : lower Cholesky factor of C^-1, of shape (p, p)
    noise : s of positions, in radii, and of normals
    shift : from the fitted parameters to the mode, of shape (p,)
    """

    factor: Tensor
    noise: tuple[float, float]
    shift: Tensor

    @cached_property
    def whitener(self) -> Tensor:
        """W, of shape (p, p), with W W^T = C^-1 undone: |W j| is the standard deviation along the row j."""
        identity = torch.eye(len(self.factor), dtype=self.factor.dtype, device=self.factor.device)
        inverse: Tensor = torch.linalg.solve_triangular(self.factor, identity, upper=False)
        return inverse


def laplace(data: DataRows) -> Laplace:
    """Return the distribution of the parameters that data points leave.

    Raises
    ------
    FitError
        When the matrix of the data cannot be factored.
    """
    everything = torch.arange(len(data), device=data.theta.device)
    terms = [Evidence.of(*data.linearise(term)) for term in data.terms(everything)]
    noise = tuple(_floored(float(term.residual.square().mean().sqrt()), t) for t, term in enumerate(terms))
    prior, centre = _prior(data, terms[0].jacobian)
    for _ in range(PASSES):
        posterior = _at(terms, noise, prior, centre)
        updated = _noise(terms, posterior)
        change = max(abs(new / old - 1) for new, old in zip(updated, noise, strict=True))
        noise = updated
        if change < SETTLED:
            break
    return _at(terms, noise, prior, centre)


def _prior(data: DataRows, values: LayeredJacobian) -> tuple[Tensor, Tensor]:
    """Return L, of shape (p,), and how far the fitted parameters lie from the prior's mean."""
    squares = values.diagonal() / len(data)
    precision, centre = torch.empty_like(squares), torch.zeros_like(squares)
    for group in values.groups:
        precision[group] = squares[group].sum().clamp_min(torch.finfo(squares.dtype).tiny) / PRIOR**2
    output = values.groups[-1]
    centre[output] = data.theta[-(output.stop - output.start) :]
    return precision, centre


def _at(terms: list[Evidence], noise: tuple[float, ...], prior: Tensor, centre: Tensor) -> Laplace:
    precision = sum((term.product / s**2 for term, s in zip(terms, noise, strict=True)), prior.new_zeros(()))
    factor = damped_factor(precision, prior)
    if factor is None:
        raise FitError("The uncertainty is not available: the matrix of the data has no Cholesky factor.")
    gradient = sum((term.gradient / s**2 for term, s in zip(terms, noise, strict=True)), prior * centre)
    shift = -torch.cholesky_solve(gradient[:, None], factor)[:, 0]
    return Laplace(factor, (noise[0], noise[1]), shift)


def _noise(terms: list[Evidence], posterior: Laplace) -> tuple[float, ...]:
    """Return the noise of each term from its residuals at the mode and the rows that remain for it."""
    covariance = torch.cholesky_inverse(posterior.factor)
    covariance.diagonal().div_(2)  # so that the lower triangles alone give the trace of the product
    found = []
    for t, (term, s) in enumerate(zip(terms, posterior.noise, strict=True)):
        taken = 2 * float((covariance.tril() * term.product.tril()).sum()) / s**2
        left = max(len(term.residual) - taken, 1.0)
        squares = float(term.residual_at(posterior.shift).square().sum())
        found.append(_floored((squares / left) ** 0.5, t))
    return tuple(found)


def _floored(noise: float, term: int) -> float:
    return max(noise, LEAST_NOISE[term])
