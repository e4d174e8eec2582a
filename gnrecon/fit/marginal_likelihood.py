"""Noise of a scan's positions and normals: by the marginal likelihood, or directly for clean scans (`clean_noise`).

The residuals y of the global field at the points of a patch are modelled as the values and gradients of a Gaussian
process c plus noise, as in `local_solve`. With the covariance K = s^2 J J^T of values and gradients of c, where J holds
the derivatives of the features' sum, and the noise covariance D, the log marginal likelihood of a patch is

    -1/2 (y^T (K + D)^-1 y + log det (K + D)) + constant.

The noise that maximises its sum over patches is selected (`MarginalLikelihood.likeliest`). All points contribute, so
that it separates noises which validation points cannot, because those have noise of their own. Length scales of noisy
scans it selects less well: under it a surface is equally curved everywhere, which no shape is. Those of clean scans it
mostly selects better (`MarginalLikelihood.likeliest_length`).

Estimated normals are no data: their errors follow from those of the positions, and are alike among neighbours. By the
values alone, a correction that cancels the global field in the whole band of noise would explain all points. So values
count as those of a function on the surface, at the foot points of the scanned ones (`SurfaceLikelihood`). It shows the
noise, the size of the correction and its length at once.
Source: Rasmussen and Williams, Gaussian Processes for Machine Learning (2006), section 5.4.1.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from gnrecon.field.random_features import Features
from gnrecon.fit.local_solve import Patch, data_kernel
from gnrecon.fit.parameters import CleanScanParameters, MarginalLikelihoodParameters, SurfaceLikelihoodParameters
from gnrecon.fit.shape_priors.edge_completion import heights_over_planes
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.signed_distance import Density
from gnrecon.runtime.parallel import map_in_threads

Place = tuple[int, int]


@dataclass(frozen=True)
class MarginalLikelihood:
    """Patches of a scan and the features of their Gaussian process.

    Parameters
    ----------
    patches : with the residuals at their points; samples of the volume are ignored
    features : whose weighted sums are the functions
    radius : of the disk that a point stands for, unit coordinates
    device : a torch device
    """

    patches: Sequence[Patch]
    features: Features
    radius: float
    device: str
    parameters: MarginalLikelihoodParameters = MarginalLikelihoodParameters()

    @classmethod
    def of(
        cls,
        patches: Sequence[Patch],
        radius: float,
        rng: np.random.Generator,
        device: str,
        *,
        parameters: MarginalLikelihoodParameters = MarginalLikelihoodParameters(),
    ) -> MarginalLikelihood:
        """Return the marginal likelihood of patches, with random features."""
        features = Features.draw(parameters.features, rng, torch.zeros(0, dtype=torch.float64, device=device))
        return cls(patches, features, radius, device, parameters)

    def likeliest(self, length: float) -> tuple[float, float]:
        """Return the noise of positions, unit coordinates, and of normals, radians, of the largest marginal likelihood.

        It is a local maximum over both tables of candidates.

        Parameters
        ----------
        length : over which the functions vary, unit coordinates
        """
        kernels = map_in_threads(
            lambda patch: data_kernel(patch, self.features, length, patch.size), self.patches, self.device
        )
        both = list(zip(self.patches, kernels, strict=True))

        @cache
        def found(place: Place) -> float:
            position, angle = self._noise_at(place)
            return sum(map_in_threads(lambda one: log_density(*one, position, angle), both, self.device))

        best = self.parameters.first_index
        for stride in self.parameters.strides:
            while (better := max(self._around(best, stride), key=found)) != best:
                best = better
        return self._noise_at(best)

    def likeliest_length(self, lengths: Sequence[float], position: float, angle: float) -> float:
        """Return the length of the largest marginal likelihood for a known noise, unit coordinates.

        Parameters
        ----------
        lengths : candidates, unit coordinates, in order: the search ends after two that are less likely in a row
        position, angle : standard deviations of the noise, unit coordinates and radians
        """

        def of(length: float) -> float:
            def of_patch(patch: Patch) -> float:
                return log_density(patch, data_kernel(patch, self.features, length, patch.size), position, angle)

            return sum(map_in_threads(of_patch, self.patches, self.device))

        best, most = 0, of(lengths[0])
        for number, length in enumerate(lengths[1:], start=1):
            if number > best + 2:
                break
            if (found := of(length)) > most:
                best, most = number, found
        return lengths[best]

    def _noise_at(self, place: Place) -> tuple[float, float]:
        positions, angles = self.parameters.position_noises_disk_radii, self.parameters.angle_noises_radians
        return positions[place[0]] * self.radius, angles[place[1]]

    def _around(self, place: Place, stride: int) -> list[Place]:
        """Return a place of both tables, and those a stride away from it in one of them."""
        i, j = place
        positions, angles = self.parameters.position_noises_disk_radii, self.parameters.angle_noises_radians
        near = [(i, j), (i - stride, j), (i + stride, j), (i, j - stride), (i, j + stride)]
        return [(p, a) for p, a in near if 0 <= p < len(positions) and 0 <= a < len(angles)]


@dataclass(frozen=True)
class SurfaceLikelihood:
    """Patches of the heights of points over the surface of the global field, a Gaussian process on it plus noise.

    Parameters
    ----------
    feet : foot points, of shape (patches, K, 3), unit coordinates
    heights : of shape (patches, K), unit coordinates
    features : whose weighted sums are the functions
    device : a torch device
    """

    feet: Tensor
    heights: Tensor
    features: Features
    device: str
    parameters: SurfaceLikelihoodParameters = SurfaceLikelihoodParameters()

    @classmethod
    def of(
        cls,
        points: Float,
        value: Float,
        gradient: Float,
        rng: np.random.Generator,
        device: str,
        *,
        parameters: SurfaceLikelihoodParameters = SurfaceLikelihoodParameters(),
    ) -> SurfaceLikelihood:
        """Return the likelihood of random patches of nearest points.

        Parameters
        ----------
        points, value, gradient : of shape (N, 3), (N,) and (N, 3), with the global field there, unit coordinates
        rng : draws patches and features
        device : a torch device
        """
        slope = np.linalg.norm(gradient, axis=1).clip(parameters.least_slope)
        height = value / slope
        # Outliers, and parts that the global field lacks, are no noise.
        near = np.abs(height) <= parameters.most_height_medians * np.median(np.abs(height))
        feet = (points - (height / slope)[:, None] * gradient)[near]
        height = height[near]
        chosen = rng.choice(len(feet), min(parameters.patches, len(feet)), replace=False)
        ranks = list(range(1, min(parameters.patch_points, len(feet)) + 1))
        rows = np.sort(cKDTree(feet).query(feet[chosen], ranks)[1])
        features = Features.draw(parameters.features, rng, torch.zeros(0, dtype=torch.float64, device=device))
        arrays = torch.as_tensor(feet[rows], device=device), torch.as_tensor(height[rows], device=device)
        return cls(*arrays, features, device, parameters)

    def likeliest(self, lengths: Sequence[float]) -> tuple[float, float, float]:
        """Return the length, size and noise of the largest marginal likelihood, all in unit coordinates.

        Parameters
        ----------
        lengths : candidates, unit coordinates
        """
        found = [(*self._of_length(length), length) for length in lengths]
        _, size, noise, length = max(found)
        return length, size, noise

    def _of_length(self, length: float) -> tuple[float, float, float]:
        """Return the largest log likelihood of a length, but for a constant, with the size and the noise."""

        def spectrum(number: int) -> tuple[Tensor, Tensor]:
            """Return the eigenvalues of a patch's covariance of size one, and the squared heights along its axes."""
            feet = self.feet[number]
            rows = self.features.phase(feet, feet.mean(dim=0), length).sin()
            values, axes = torch.linalg.eigh(rows @ rows.T * (2.0 / len(self.features)))
            return values.clamp_min(0.0), (axes.T @ self.heights[number]).square()

        spectra = map_in_threads(spectrum, range(len(self.feet)), self.device)
        values, squares = (torch.cat(parts) for parts in zip(*spectra, strict=True))
        best = (-np.inf, 0.0, 0.0)
        for ratio in self.parameters.ratios:
            variance = 1.0 + ratio**2 * values
            # For a ratio of size and noise, the likeliest noise is known in closed form.
            noise = float((squares / variance).mean().sqrt())
            density = -len(values) * math.log(max(noise, 1e-300)) - 0.5 * float(variance.log().sum())
            best = max(best, (density, ratio * noise, noise))
        return best


def log_density(patch: Patch, kernel: Tensor, position: float, angle: float) -> float:
    """Return the log density of a patch's values and gradients, but for a constant; of an indefinite system, -infinity.

    Parameters
    ----------
    patch : Patch
    kernel : of shape (4 N, 4 N), covariance of its N values and its gradients, as `patch.data_kernel` returns it
    position, angle : standard deviations of the noise of positions, unit coordinates, and of normals, radians
    """
    count = len(patch.value)
    noise = torch.cat(
        [patch.value.new_full((size,), deviation**2) for size, deviation in ((count, position), (3 * count, angle))]
    )
    factor, failed = torch.linalg.cholesky_ex(kernel + noise.diag())
    if failed:
        return -np.inf
    seen = torch.cat([patch.value, patch.gradient.T.flatten()])
    white = torch.linalg.solve_triangular(factor, seen[:, None], upper=False)
    return -0.5 * float(white.square().sum()) - float(factor.diagonal().log().sum())


Noise = tuple[float, float]

# Scans so clean that their noise need not be chosen.
#
# Two neighbours of a smooth surface lie nearly as high over each other's tangent planes, with opposite signs: half the
# sum of both heights is nothing on planes, spheres and round cylinders, and of third order in their distance elsewhere.
# Noise of positions is of order zero there, and that of normals of order one. So pairs of points show the noise without
# a fitted surface. Validation points hardly show the noise of a clean scan: they lie a spacing away from the others,
# where the unknown shape matters far more than a noise of a hundredth of that.


def clean_noise(
    points: Float,
    normals: Float,
    density: Density,
    rms: float,
    estimated: bool,
    clean: bool | None = None,
    *,
    parameters: CleanScanParameters = CleanScanParameters(),
) -> Noise | None:
    """Return the noise of positions, unit coordinates, and normals, radians, of a clean scan; None of any other.

    It is also None where the global field has no residuals to correct.

    Parameters
    ----------
    points, normals : arrays of shape (N, 3), unit normals
    density : of the points
    rms : root mean square of the residuals of the global field, unit coordinates
    estimated : whether the normals were found from the points
    clean : whether the scan is, where that was found with its normals; pairs do not show it where they lie as far apart
        as the surface's features
    """
    if clean is False or rms < parameters.least_residual_disk_radii * density.radius:
        return None
    height = 0.0 if clean else median_pair_height(points, normals, density, parameters=parameters)
    if not height <= parameters.most_height:
        return None
    least = parameters.least_position_noise_disk_radii
    if estimated:
        return least * density.radius, parameters.estimated_angle_noise_radians
    angle = max(parameters.angle_over_position_noise * height, parameters.least_angle_noise_radians)
    return max(height, least) * density.radius, angle


def median_pair_height(
    points: Float,
    normals: Float,
    density: Density,
    *,
    parameters: CleanScanParameters = CleanScanParameters(),
) -> float:
    """Return the median height of neighbours over the surface through both their tangent planes; NaN for few pairs.

    It is half the sum of both heights over each other's planes, over the larger of their distance and a disk's radius.
    The parameters are those of `clean_noise`.
    """
    some = slice(None, None, -(-len(points) // parameters.most_points))
    disks = density.disks[some, None]
    ranks = list(range(2, min(parameters.neighbours + 1, len(points)) + 1))
    distance, near = density.tree.query(points[some], ranks)
    cosine = np.einsum("ikd,id->ik", normals[near], normals[some])
    least_cosine = np.cos(np.radians(parameters.most_normal_angle_degrees))
    paired = (distance > 0) & (distance < parameters.reach_disk_radii * disks) & (cosine > least_cosine)
    if paired.sum() < parameters.least_pairs:
        return np.nan
    height, own = heights_over_planes(points, normals, some, near)
    return float(np.median((np.abs(height - own) / 2 / np.maximum(distance, disks))[paired]))
