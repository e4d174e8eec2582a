"""How uncertain the position of a fitted surface is, from place to place.

A field f with parameters of covariance C has at x the variance J C J^T, J its derivatives by the parameters, and its
zero level the standard deviation

    sigma(x) = c sqrt(J C J^T) / |grad f|

along the normal, to first order. C is the Laplace approximation (`laplace`), and c one factor for all places, from the
errors at points that are left out (`calibration`). Sigma is small where the scan is dense, grows with the distance from
it, and is largest where the surface faces away from all points, as in a hole. In holes, the default fit is its smooth
global field, and no local field has data on the errors there. Its sigma is that of a surrogate: one layer of rougher
features with the same data, whose errors are larger.

Source: Sellan and Jacobson, Stochastic Poisson Surface Reconstruction (2022), for the idea of a surface with an
error bar; the formula is the delta method.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from gnrecon.fit.field_model import NeuralSDF
from gnrecon.fit.fit_field import fit
from gnrecon.fit.fit_options import FitOptions, normal_residual
from gnrecon.fit.objective import normal_weight
from gnrecon.fit.parameters import UncertaintyParameters
from gnrecon.fit.posterior.laplace_approximation import DataRows, Laplace, laplace
from gnrecon.geometry.arrays import Float, Int
from gnrecon.geometry.point_cloud import Samples
from gnrecon.geometry.signed_distance import Density
from gnrecon.runtime.chunks import slices


@dataclass(frozen=True)
class NetworkDeviation:
    """Standard deviations of one network.

    Parameters
    ----------
    rows : the data that it was fitted to
    whitener : of shape (p, p), single precision, with C = W^T W for the covariance C of the free parameters
    """

    rows: DataRows
    whitener: Tensor

    def at(self, x: Float, *, batch_points: int = UncertaintyParameters.batch_points) -> Float:
        """Return the standard deviation of the network's value, of shape (N,), at x, of shape (N, 3)."""
        points = torch.as_tensor(x).to(self.rows.theta)
        parts = [self._at(points[rows]) for rows in slices(len(points), batch_points)]
        return np.concatenate([np.zeros(0), *parts])

    def _at(self, x: Tensor) -> Float:
        # Rows are made in double precision: frequencies are high, and phases must be exact before they are rounded.
        variances = [(chunk.float() @ self.whitener.T).square().sum(1) for chunk in self.rows.values(x).dense()]
        deviation: Float = torch.cat(variances).sqrt().double().cpu().numpy()
        return deviation


@dataclass(frozen=True)
class Uncertainty:
    """Standard deviations of a fitted surface, along its normal.

    Parameters
    ----------
    sdf : the fitted field
    deviation : of the field's values, or of its surrogate's, before calibration
    noise : of the points along the normal with which they and their normals fit together, file units
    factor : c, by which errors at left-out points exceed what C alone says
    """

    sdf: NeuralSDF
    deviation: NetworkDeviation
    noise: float
    factor: float

    def __repr__(self) -> str:
        return f"<Uncertainty: noise {self.noise:.3g} in file units, factor {self.factor:.3g}>"

    @classmethod
    def of(
        cls,
        sdf: NeuralSDF,
        samples: Samples,
        seed: int = 0,
        *,
        parameters: UncertaintyParameters = UncertaintyParameters(),
    ) -> Uncertainty:
        """Return the uncertainty of a field that was fitted to `samples`.

        Parameters
        ----------
        sdf : NeuralSDF
            However it was fitted.
        samples : Samples
        seed : int
            Of the points that are left out.

        Raises
        ------
        FitError
            When the matrix of the data cannot be factored, because it is not finite.
        """
        if sdf.detail is not None:
            return replace(cls.of(_surrogate(sdf, samples), samples, seed, parameters=parameters), sdf=sdf)
        rng = np.random.default_rng(seed)
        chosen = np.sort(rng.permutation(len(samples))[: parameters.most_points])
        points, normals = (
            torch.as_tensor(values[chosen]).to(sdf.theta) for values in (samples.points, samples.normals)
        )
        residual = normal_residual(str(sdf.options.get("normals", FitOptions.normals)))
        weight = normal_weight(Density(samples.points).spacing)
        rows = DataRows(sdf.field, sdf.theta, points, normals, residual, weight)
        posterior = laplace(rows)
        factor = calibration(rows, posterior, seed, parameters=parameters)
        deviation = NetworkDeviation(rows, posterior.whitener().float())
        return cls(sdf, deviation, posterior.noise * sdf.frame.scale, factor)

    def sigma(self, points: npt.ArrayLike, *, least_slope: float = UncertaintyParameters.least_slope) -> Float:
        """Return the standard deviation of the surface, of shape (N,), at points on it, of shape (N, 3); file units.

        Away from the surface it is that of the level set through the point.
        """
        x = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        slope = np.maximum(np.linalg.norm(self.sdf.gradient(x), axis=1), least_slope)
        sigma: Float = self.factor * self.sdf.frame.scale * self.deviation.at(self.sdf.frame.to_unit(x)) / slope
        return sigma

    def describe(self) -> str:
        """Return the noise and the factor as a phrase."""
        return f"noise {self.noise:.3g}, calibrated by a factor {self.factor:.3g} on left-out points"


def _surrogate(sdf: NeuralSDF, samples: Samples) -> NeuralSDF:
    """Return one layer of features that is fitted to the same samples by a linear solve."""
    options = FitOptions(steps=0, seed=int(sdf.options.get("seed", 0)), device=str(sdf.theta.device))
    return fit(samples, options)[0]


# Calibration by leave-one-out and leave-patch-out errors, without a reference.
#
# For a linear least-squares fit with whitened rows R of some left-out points and residuals e at the mode, the fit
# without them would have had the residuals (I - H)^-1 e, of covariance (I - H)^-1, with H = R C R^T: nothing is fitted
# again. Source: Cook and Weisberg, Residuals and Influence in Regression (1982), section 2. Where the fitted field is
# not the mode, because it has other terms than the data, its distance from the mode is added as an independent error.
#
# Points are left out one by one, and in patches of neighbours, like a hole of the scan: errors between
# points and errors across holes have equal weight.


def calibration(
    data: DataRows,
    posterior: Laplace,
    seed: int = 0,
    *,
    parameters: UncertaintyParameters = UncertaintyParameters(),
) -> float:
    """Return the factor, at least one, by which predicted standard deviations must grow to cover the left-out points.

    With it, 95.45 % of the left-out positions lie within two standard deviations, or more where it is one; each size of
    patch has the same weight.
    """
    rng = np.random.default_rng(seed)
    patches = zip(parameters.patch_sizes, parameters.patch_counts, strict=True)
    kept = [(size, count) for size, count in patches if size == 1 or 5 * size <= len(data)]
    scores = [np.abs(left_out_scores(data, posterior, size, count, rng)) for size, count in kept]
    weights = np.concatenate([np.full(len(z), 1 / len(z)) for z in scores]) / len(scores)
    together = np.concatenate(scores)
    order = np.argsort(together)
    place = int(np.searchsorted(np.cumsum(weights[order]), parameters.coverage))
    return max(1.0, float(together[order[min(place, len(order) - 1)]]) / 2)


def left_out_scores(data: DataRows, posterior: Laplace, size: int, count: int, rng: np.random.Generator) -> Float:
    """Return errors of left-out positions over their predicted standard deviations, `size` for each patch."""
    points = data.points.cpu().numpy()
    centres = rng.permutation(len(points))[:count]
    patches = cKDTree(points).query(points[centres], list(range(1, size + 1)))[1]
    several = max(1, UncertaintyParameters.calibration_batch_points // size)
    return np.concatenate([_scores(data, posterior, patches[rows]) for rows in slices(len(patches), several)])


def _scores(data: DataRows, posterior: Laplace, patches: Int) -> Float:
    """Return the scores of some patches, of shape (count, size), flattened."""
    count, size = patches.shape
    rows, residuals, steps = _whitened(data, posterior, torch.as_tensor(patches.ravel(), device=data.theta.device))
    half = torch.linalg.solve_triangular(posterior.factor, rows.T, upper=False).T
    # A point has several rows, of which the interface's comes first.
    half, at_mode = half.reshape(-1, count, size, half.shape[1]), (residuals + steps).reshape(-1, count, size)
    shift = steps.reshape(-1, count, size)[0]
    found = []
    for number in range(count):
        spread = _without(half[:, number].flatten(0, 1))
        error = torch.hypot((spread @ at_mode[:, number].flatten())[:size], shift[number])
        found.append(error / spread.diagonal()[:size].sqrt())
    return torch.cat(found).cpu().numpy()


def _without(half: Tensor, *, least_variance: float = UncertaintyParameters.least_residual_variance) -> Tensor:
    """Return (I - H)^-1, of shape (m, m), for H = A A^T with A of shape (m, p)."""
    # By eigenvectors, because rounding may take an eigenvalue of H, which is less than one, beyond one.
    values, vectors = torch.linalg.eigh(half @ half.T)
    spread: Tensor = (vectors / (1.0 - values).clamp(least_variance, 1.0)) @ vectors.T
    return spread


def _whitened(data: DataRows, posterior: Laplace, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return rows J, residuals r and J s for the shift s to the mode, in units of the noise."""
    jacobian, residual = data.linearise(points)
    # The next chunk may overwrite the last one.
    rows = torch.cat([chunk.clone() for chunk in jacobian.dense()])
    return rows / posterior.noise, residual / posterior.noise, jacobian.mv(posterior.shift) / posterior.noise
