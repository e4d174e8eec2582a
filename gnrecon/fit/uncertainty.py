"""How uncertain the position of a fitted surface is, from place to place.

A field f with parameters of covariance C has at x the variance J C J^T, J its derivatives by the parameters, and its
zero level the standard deviation

    sigma(x) = c sqrt(J C J^T) / |grad f|

along the normal, to first order. C is the Laplace approximation (`laplace`), and c one factor for all places, from the
errors where data is left out (`left_out`). Small where the scan is dense, sigma grows with the distance from it, and
most where the surface turns its back to all points, as in a hole.
A field with local detail is smoother than the scan in holes, and what it does not know there no cube's data tells. Its
sigma is that of a stand-in, one layer of rougher features with the same data, whose errors are larger than its own.

Source: Sellan and Jacobson, Stochastic Poisson Surface Reconstruction (2022), for the idea of a surface with an
error bar; the formula is the delta method.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from gnrecon.fit.data_rows import DataRows
from gnrecon.fit.laplace import laplace
from gnrecon.fit.left_out import calibration
from gnrecon.fit.loss import normal_weight
from gnrecon.fit.options import FitOptions, normal_residual
from gnrecon.fit.schedule import fit
from gnrecon.fit.sdf import NeuralSDF
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.point_cloud import Samples
from gnrecon.geometry.signed_distance import Density
from gnrecon.runtime.parallel import slices

MOST_POINTS = 20_000
"""Data points that count; more of them are thinned at random, so that sigma is rather too large."""

BATCH = 8192
LEAST_SLOPE = 0.1
"""Of the field, whose gradient should have length one; near its critical points the first order says nothing."""


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

    def at(self, x: Float) -> Float:
        """Return the standard deviation of the network's value, of shape (N,), at x, of shape (N, 3)."""
        points = torch.as_tensor(x).to(self.rows.theta)
        parts = [self._at(points[rows]) for rows in slices(len(points), BATCH)]
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
    deviation : of the field's values, or of its stand-in's, before it is calibrated
    noise : of the points along the normal with which they and their normals fit together, file units
    factor : c, by which errors at left-out points exceed what C alone says
    """

    sdf: NeuralSDF
    deviation: NetworkDeviation
    noise: float
    factor: float

    @classmethod
    def of(cls, sdf: NeuralSDF, samples: Samples, seed: int = 0) -> Uncertainty:
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
            return replace(cls.of(_stand_in(sdf, samples), samples, seed), sdf=sdf)
        rng = np.random.default_rng(seed)
        chosen = np.sort(rng.permutation(len(samples))[:MOST_POINTS])
        points, normals = (
            torch.as_tensor(values[chosen]).to(sdf.theta) for values in (samples.points, samples.normals)
        )
        residual = normal_residual(str(sdf.options.get("normals", FitOptions.normals)))
        weight = normal_weight(Density(samples.points).spacing)
        rows = DataRows(sdf.field, sdf.theta, points, normals, residual, weight)
        posterior = laplace(rows)
        factor = calibration(rows, posterior, seed)
        deviation = NetworkDeviation(rows, posterior.whitener().float())
        return cls(sdf, deviation, posterior.noise * sdf.frame.scale, factor)

    def sigma(self, points: npt.ArrayLike) -> Float:
        """Return the standard deviation of the surface, of shape (N,), at points on it, of shape (N, 3); file units.

        Away from the surface it is that of the level set through the point.
        """
        x = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        slope = np.maximum(np.linalg.norm(self.sdf.gradient(x), axis=1), LEAST_SLOPE)
        sigma: Float = self.factor * self.sdf.frame.scale * self.deviation.at(self.sdf.frame.to_unit(x)) / slope
        return sigma

    def describe(self) -> str:
        """Return the noise and the factor as a phrase."""
        return f"noise {self.noise:.3g}, calibrated by {self.factor:.3g} where data is left out"


def _stand_in(sdf: NeuralSDF, samples: Samples) -> NeuralSDF:
    """Return one layer of features that is fitted to the same samples by a linear solve."""
    asked = FitOptions(steps=0, seed=int(sdf.options.get("seed", 0)), device=str(sdf.theta.device))
    return fit(samples, asked)[0]
