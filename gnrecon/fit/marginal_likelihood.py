"""Noise of a scan's positions and normals: by the marginal likelihood, or directly for clean scans (`clean_noise`).

The residuals y of the global field at the points of a patch are modelled as the values and gradients of a Gaussian
process c plus noise, as in `local_solve`. With the covariance K = s^2 J J^T of values and gradients of c, where J holds
the derivatives of the features' sum, and the noise covariance D, the log marginal likelihood of a patch is

    -1/2 (y^T (K + D)^-1 y + log det (K + D)) + constant.

The noise that maximises its sum over patches is selected (`MarginalLikelihood.likeliest`). All points contribute, so
that it separates noises which validation points cannot, because those have noise of their own. It selects length scales
less well: under it a surface is equally curved everywhere, which no shape is.
Source: Rasmussen and Williams, Gaussian Processes for Machine Learning (2006), section 5.4.1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from torch import Tensor

from gnrecon.field.random_features import Features
from gnrecon.fit.local_solve import Patch, data_kernel
from gnrecon.fit.parameters import CleanScanParameters, MarginalLikelihoodParameters
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

    def likeliest(self, length: float, near: Place | None = None) -> Place:
        """Return where the noises of the largest marginal likelihood are in both tables of candidates.

        It is a local maximum.

        Parameters
        ----------
        length : over which the functions vary, unit coordinates
        near : place of those of a similar length, where the search begins
        """
        kernels = map_in_threads(
            lambda patch: data_kernel(patch, self.features, length, patch.size), self.patches, self.device
        )
        both = list(zip(self.patches, kernels, strict=True))

        @cache
        def found(place: Place) -> float:
            position, angle = self.noise_at(place)
            return sum(map_in_threads(lambda one: log_density(*one, position, angle), both, self.device))

        best = near or self.parameters.first_index
        for stride in self.parameters.strides if near is None else self.parameters.strides[-1:]:
            while (better := max(self._around(best, stride), key=found)) != best:
                best = better
        return best

    def noise_at(self, place: Place) -> tuple[float, float]:
        """Return the noise of positions, unit coordinates, and of normals, radians, at a place in both tables."""
        positions, angles = self.parameters.position_noises_disk_radii, self.parameters.angle_noises_radians
        return positions[place[0]] * self.radius, angles[place[1]]

    def _around(self, place: Place, stride: int) -> list[Place]:
        """Return a place of both tables, and those a stride away from it in one of them."""
        i, j = place
        positions, angles = self.parameters.position_noises_disk_radii, self.parameters.angle_noises_radians
        near = [(i, j), (i - stride, j), (i + stride, j), (i, j - stride), (i, j + stride)]
        return [(p, a) for p, a in near if 0 <= p < len(positions) and 0 <= a < len(angles)]


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
    """
    if rms < parameters.least_residual_disk_radii * density.radius:
        return None
    height = median_pair_height(points, normals, density, parameters=parameters)
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
