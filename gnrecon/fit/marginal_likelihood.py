"""Noise of a scan's positions and normals, by its evidence: how probable noise and a smooth surface make what is seen.

What a global field leaves over at the points of a patch is taken for a random function c, as `patch` does, plus noise.
Values and gradients of c have a covariance K = s^2 J J^T, J being the derivatives of the features' weighted sum, so
that with noise of covariance D what is left over, y, has the log density

    -1/2 (y^T (K + D)^-1 y + log det (K + D)) + constant,

whose sum over patches is the evidence. All points tell it, and where left-out points say the same of several noises,
because the noise of their own normals hides the difference, it still tells them apart. Lengths it tells less well: for
it a surface is as bent everywhere, which no shape is.
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
from gnrecon.fit.shape_priors.edge_completion import heights_over_planes
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.signed_distance import Density
from gnrecon.runtime.parallel import abreast

POSITIONS = (0.005, 0.01, 0.02, 0.035, 0.05, 0.07, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5)
"""Noise of the positions to choose from, over the radius of a point's disk."""

ANGLES = (0.01, 0.02, 0.03, 0.05, 0.07, 0.1, 0.13, 0.17, 0.23, 0.3, 0.4)
"""Noise of the normals to choose from, in radians."""

FIRST = 6, 5

STRIDES = 2, 1
"""Where the search in both tables begins, and its strides."""

PATCHES, POINTS, FEATURES = 20, 60, 700
"""Patches, the nearest points about a place each, and features that make up their covariance."""

Place = tuple[int, int]


@dataclass(frozen=True)
class Evidence:
    """Patches of a scan, which tell its noise.

    Parameters
    ----------
    patches : what is left over at some points each; samples of the volume count for nothing
    features : whose weighted sums are the functions
    radius : of the disk that a point stands for, unit coordinates
    device : a torch device
    """

    patches: Sequence[Patch]
    features: Features
    radius: float
    device: str

    @classmethod
    def of(cls, patches: Sequence[Patch], radius: float, rng: np.random.Generator, device: str) -> Evidence:
        """Return the evidence of patches, drawing its features."""
        features = Features.draw(FEATURES, rng, torch.zeros(0, dtype=torch.float64, device=device))
        return cls(patches, features, radius, device)

    def noise(self, length: float) -> tuple[float, float]:
        """Return the noise of positions, unit coordinates, and of normals, radians, that has most evidence.

        It is a place in both tables that no neighbour in them excels.

        Parameters
        ----------
        length : over which the functions vary, unit coordinates
        """
        kernels = abreast(
            lambda patch: data_kernel(patch, self.features, length, patch.size), self.patches, self.device
        )
        both = list(zip(self.patches, kernels, strict=True))

        @cache
        def found(place: Place) -> float:
            position, angle = self._noise_at(place)
            return sum(abreast(lambda one: log_density(*one, position, angle), both, self.device))

        best = FIRST
        for stride in STRIDES:
            while (better := max(_around(best, stride), key=found)) != best:
                best = better
        return self._noise_at(best)

    def _noise_at(self, place: Place) -> tuple[float, float]:
        return POSITIONS[place[0]] * self.radius, ANGLES[place[1]]


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


def _around(place: Place, stride: int) -> list[Place]:
    """Return a place of both tables, and those a stride beside it in one of them."""
    i, j = place
    beside = [(i, j), (i - stride, j), (i + stride, j), (i, j - stride), (i, j + stride)]
    return [(p, a) for p, a in beside if 0 <= p < len(POSITIONS) and 0 <= a < len(ANGLES)]


Noise = tuple[float, float]

NEIGHBOURS, DISKS = 5, 2.0
"""Neighbours of a point that are asked, and how far they are at most, in radii of its disk."""

ALIKE = np.cos(np.radians(25.0))
"""Cosine of the angle between two normals up to which they may belong to one smooth piece of surface."""

CLEAN = 0.04
"""Median of the heights, in radii of a disk or over the distance where that is longer, up to which a scan is clean.
Vertices of scanned meshes have 0.017 to 0.024, a noise of 0.08 radii 0.06, range scans 0.14 and more."""

LEAST_PAIRS, MOST_POINTS = 20, 50_000
"""Fewest pairs that tell anything, and points whose neighbours are asked at most."""

LEAST_OVER = 0.01
"""Root mean square of what the global field leaves over, in radii of a disk, below which there is nothing to gain."""

POSITION, ANGLE, TURNED = 0.005, 0.01, 2.0
"""Least noise that is believed of positions, in radii of a disk, and of normals, in radians, and the latter over the
former: where neighbours stand a radius apart, noise of the normals alone would make such heights."""

ESTIMATED = 0.1
"""Noise of normals that were estimated, in radians: their error, which no neighbours tell, as theirs is about the same.
"""


# Scans so clean that their noise need not be chosen.
#
# Two neighbours of a smooth surface lie nearly as high over each other's tangent planes, with opposite signs: half the
# sum of both heights is nothing on planes, spheres and round cylinders, and of third order in their distance elsewhere.
# Noise is of order zero there, and that of the normals of order one. So points tell by themselves, without a surface,
# how noisy they are. Left-out points tell it of clean scans hardly at all: they lie a spacing away from the others,
# where the shape that is not known matters far more than a noise of a hundredth of that.


def clean_noise(points: Float, normals: Float, density: Density, over: float, estimated: bool) -> Noise | None:
    """Return the noise of positions, unit coordinates, and normals, radians, of a clean scan; None of any other.

    It is also None where a field that is to be corrected leaves nothing over at the points.

    Parameters
    ----------
    points, normals : arrays of shape (N, 3), unit normals
    density : of the points
    over : root mean square of what is left over, unit coordinates
    estimated : whether the normals were found from the points
    """
    if over < LEAST_OVER * density.radius:
        return None
    height = heights(points, normals, density)
    if not height <= CLEAN:
        return None
    if estimated:
        return POSITION * density.radius, ESTIMATED
    return max(height, POSITION) * density.radius, max(TURNED * height, ANGLE)


def heights(points: Float, normals: Float, density: Density) -> float:
    """Return the median height of neighbours over the surface that both their normals tell; NaN of too few pairs.

    It is half the sum of both heights over each other's planes, over the larger of their distance and a disk's radius.
    The parameters are those of `clean_noise`.
    """
    asked = slice(None, None, -(-len(points) // MOST_POINTS))
    disks = density.disks[asked, None]
    ranks = list(range(2, min(NEIGHBOURS + 1, len(points)) + 1))
    distance, near = density.tree.query(points[asked], ranks)
    cosine = np.einsum("ikd,id->ik", normals[near], normals[asked])
    paired = (distance > 0) & (distance < DISKS * disks) & (cosine > ALIKE)
    if paired.sum() < LEAST_PAIRS:
        return np.nan
    height, own = heights_over_planes(points, normals, asked, near)
    return float(np.median((np.abs(height - own) / 2 / np.maximum(distance, disks))[paired]))
