"""The exact fit of one cube's sine features to the residuals of the global field.

A correction c = sum_j a_j sin(F_j . (x - c_0) / l + p_j) with independent normal a_j of variance 2 s^2 / m is, for many
features, a Gaussian process of standard deviation s and length scale l. The data are f + c = 0 and grad(f + c) = n at
the points, with noise in position and in normals, and f + c near the coarse distance at samples of free space, within a
share of it. The most probable amplitudes solve one linear system (`PatchSystem`, or `LocalRowSystem` for few points).
Free space keeps its sign: where the correction is beyond its bounds, samples are added with the bound as their target
(`PatchSystem.solve_with_bounds`).
Source: Rasmussen and Williams, Gaussian Processes for Machine Learning (2006), section 2.1, with the features of Rahimi
and Recht (2007) and observations of the gradient.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property, partial

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from gnrecon.field.random_features import Features
from gnrecon.fit.free_space import LatticeVolume
from gnrecon.fit.parameters import LocalSolveParameters
from gnrecon.least_squares.direct import damped_factor, solve_factored
from gnrecon.least_squares.layer_products import gram_and_product
from gnrecon.runtime.chunks import slices


@dataclass(frozen=True)
class Patch:
    """Data of a correction.

    Parameters
    ----------
    points : of shape (N, 3), unit coordinates
    value, gradient : what c and grad c should be there, of shape (N,) and (N, 3)
    volume : samples of shape (Q, 3)
    wanted, distance : target of c there, and the distance from the data, both of shape (Q,)
    lower, upper : of shape (Q,), what c must be at least and at most at the samples
    zero : of shape (Q,), the c at which the corrected field vanishes there
    center : of shape (3,), origin of the features' coordinates
    weights : of shape (N,), of the points, or None where all have a weight of one
    normal_weights : of shape (N,), by which their normals count besides, or None
    """

    points: Tensor
    value: Tensor
    gradient: Tensor
    volume: Tensor
    wanted: Tensor
    lower: Tensor
    upper: Tensor
    zero: Tensor
    distance: Tensor
    center: Tensor
    weights: Tensor | None = None
    normal_weights: Tensor | None = None

    @property
    def size(self) -> float:
        """Prior standard deviation of the correction; a tiny one where there is nothing to correct."""
        return LocalSolveParameters.correction_rms_factor * self.rms

    @property
    def rms(self) -> float:
        """Root mean square of what the correction should be at the points, or a tiny value."""
        return max(float(self.value.square().mean().sqrt()), 1e-6)

    @property
    def weights_of_normals(self) -> Tensor | None:
        """Weights of the points' normals, of shape (N,), or None where all have a weight of one."""
        if self.weights is None or self.normal_weights is None:
            return self.weights if self.normal_weights is None else self.normal_weights
        return self.weights * self.normal_weights

    def deviation(self, length: float, size: float) -> Tensor:
        """Return the standard deviation of what the correction should be at the samples of the volume, of shape (Q,).

        It is a share of the distance, but where no sign is certain, as across a hole, at most what a correction of that
        length and size has left there: finite features do not fade by themselves, and would crumple the film.
        """
        wide = LocalSolveParameters.volume_deviation_share * self.distance
        left = size * (torch.exp(-0.5 * (self.distance / length).square()) + LocalSolveParameters.faded_share)
        doubtful = self.lower.isinf() & self.upper.isinf() & (self.wanted == 0.0)
        return torch.where(doubtful, torch.minimum(wide, left), wide)


class PatchSystem:
    """The normal equations of a patch, assembled once and solved for any noise.

    Parameters
    ----------
    patch : Patch
    features : of lower precision than the patch, they make assembly faster; sums over rows keep that of the patch
    length : of the features, unit coordinates
    size : standard deviation of the function, unit coordinates
    """

    def __init__(self, patch: Patch, features: Features, length: float, size: float) -> None:
        self._size, self._scale = size, size * (2.0 / len(features)) ** 0.5
        self._patch, self._features, self._length = patch, features, length

    @cached_property
    def _positions(self) -> tuple[Tensor, Tensor]:
        """J^T J and J^T y of the values."""
        values, weighted = self._patch.value, partial(_weighted, self._patch.weights)
        return self._sums((weighted(z.sin(), rows), weighted(values[rows], rows)) for rows, z in self._phases())

    @cached_property
    def _angles(self) -> tuple[Tensor, Tensor]:
        """J^T J and J^T y of the gradients.

        The rows of an axis are cosines C times the features' slopes S along it, and all axes have one noise: J^T J is
        the Hadamard product of C^T C and S^T S, a third of the work of three products.
        """
        wanted, slopes = self._patch.gradient, self._features.frequencies / self._length
        weighted = partial(_weighted, self._patch.weights_of_normals)
        cosines = ((weighted(z.cos(), rows), weighted(wanted[rows], rows)) for rows, z in self._phases())
        product, along = self._sums(cosines, 3)
        slopes = slopes.to(product)
        return product.mul_(self._features.products.to(product)).div_(self._length**2), (along * slopes).sum(dim=1)

    @cached_property
    def _deviation(self) -> Tensor:
        """Standard deviation of the samples of the volume."""
        return self._patch.deviation(self._length, self._size)

    @cached_property
    def _free(self) -> Features:
        """The features of the volume: its deviations are wide, so that single precision is mostly enough."""
        return self._features.precise_enough(float((self._size / self._deviation).square().sum()))

    @cached_property
    def _sines(self) -> Tensor:
        """The features at the samples of the volume."""
        return self._free.phase(self._patch.volume, self._patch.center, self._length).sin()

    @cached_property
    def _volume(self) -> tuple[Tensor, Tensor]:
        """J^T J and J^T y of the samples of the volume."""
        wanted, deviation = self._patch.wanted, self._deviation
        return self._sums([(self._sines / deviation[:, None].to(self._sines), wanted / deviation)])

    def _phases(self) -> Iterable[tuple[slice, Tensor]]:
        """Return rows of points with the features' phases there, of shape (N, m)."""
        chunks = slices(len(self._patch.value), LocalSolveParameters.chunk_points)
        return ((rows, self._phase(rows)) for rows in chunks) if len(chunks) > 1 else self._few_phases

    @cached_property
    def _few_phases(self) -> list[tuple[slice, Tensor]]:
        """These of few points."""
        return [(slice(None), self._phase(slice(None)))]

    def _phase(self, rows: slice) -> Tensor:
        return self._features.phase(self._patch.points[rows], self._patch.center, self._length)

    def _sums(self, chunks: Iterable[tuple[Tensor, Tensor]], *columns: int) -> tuple[Tensor, Tensor]:
        """Return J^T J, in its lower triangle, and J^T y of chunks of rows J with their targets y, of `columns`."""
        return gram_and_product(chunks, len(self._features), self._patch.value, *columns)

    def solve(self, position: float, angle: float) -> Tensor:
        """Return amplitudes, of shape (m,), for standard deviations of the noise of positions and normals.

        Where rounding makes the system indefinite, it is damped more.
        """
        factor, right = self._factored(position, angle)
        if factor is None:
            return torch.zeros_like(right)
        amplitudes: Tensor = self._scale * solve_factored(factor, right)
        return amplitudes

    def solve_with_bounds(
        self,
        position: float,
        angle: float,
        near: LatticeVolume | None = None,
        *,
        parameters: LocalSolveParameters = LocalSolveParameters(),
    ) -> Tensor:
        """Return amplitudes, of shape (m,), as `solve` does, after which c keeps its bounds at nearly all samples.

        A one-sided penalty by an active set: where the corrected field has the wrong sign, or far from the data less
        than half of its bound, a row with the bound as target is added, heavier in each pass. Samples within a length
        of each other say the same and weigh as one together: else the many of a gap in the data would outweigh its
        points, or the few of a wart would not suffice.

        Parameters
        ----------
        position, angle : standard deviations of the noise
        near : samples near the data, of which the bounds alone are used
        """
        amplitudes, patch = self.solve(position, angle), self._patch
        places, distance, lower, upper = patch.volume, patch.distance, patch.lower, patch.upper
        least, most = (lower + patch.zero) / 2, (upper + patch.zero) / 2
        if near is not None:
            sums_near = near.sums(self._free, self._length)
            points, _, low, high, zero, off = (
                torch.as_tensor(values).to(patch.value) for values in near.volume.arrays()
            )
            places, distance = torch.cat([places, points]), torch.cat([distance, off])
            lower, upper = torch.cat([lower, low]), torch.cat([upper, high])
            least = torch.cat([least, torch.where(low.isfinite(), zero, low)])
            most = torch.cat([most, torch.where(high.isfinite(), zero, high)])
        share = parameters.bound_deviation_share
        for _ in range(parameters.bound_passes):
            value = self._sines @ amplitudes.to(self._sines)
            value = (value if near is None else torch.cat([value, sums_near(amplitudes)])).to(lower)
            low, high = value < least, value > most
            if not (beyond := low | high).any():
                break
            deviation = share * distance[beyond] * _crowd(places[beyond], self._length).sqrt()
            rows = self._free.phase(places[beyond], patch.center, self._length).sin_()
            rows /= deviation[:, None].to(rows)
            wanted = torch.where(low, lower, upper)[beyond] / deviation
            self._volume[0].add_(rows.T @ rows)
            self._volume[1].add_(rows.T @ wanted.to(rows))
            amplitudes = self.solve(position, angle)
            share *= parameters.bound_tightening
        return amplitudes

    def reweighted(
        self, position: float, angle: float, *, parameters: LocalSolveParameters = LocalSolveParameters()
    ) -> PatchSystem:
        """Return the system with less weight of points that contradict the others, or itself where none does.

        By iteratively reweighted least squares, see `robust_weights`; `position` and `angle` are the noise.
        """
        system = self
        for _ in range(parameters.robust_passes):
            weights = system.robust_weights(position, angle)
            if not (weights < 1.0).any():
                break
            patch = replace(self._patch, weights=weights)
            system = PatchSystem(patch, self._features, self._length, self._size)
        return system

    def robust_weights(
        self, position: float, angle: float, *, parameters: LocalSolveParameters = LocalSolveParameters()
    ) -> Tensor:
        """Return weights of the points, of shape (N,), below one where a point contradicts all others.

        The misfit of a point to the correction that the others give is r / (1 - h), with its residual r and leverage
        h: clean data pulls the surface to an outlier, so that r alone does not show it. Beyond `robust_deviations`
        the weight falls with the square of the misfit, over the larger of the noise and what misfits have by their
        median.
        Source: Cook and Weisberg, *Residuals and Influence in Regression* (1982), for leave-one-out residuals; Holland
        and Welsch, *Robust Regression Using Iteratively Reweighted Least-Squares* (1977), for the weights.
        """
        factor, right = self._factored(position, angle)
        ones = torch.ones_like(self._patch.value)
        if factor is None:
            return ones
        solution, weights = solve_factored(factor, right), self._patch.weights
        parts = []
        for rows, z in self._phases():
            sines = self._scale * z.sin().to(factor)
            leverage = torch.linalg.solve_triangular(factor, sines.T, upper=False).square().sum(dim=0) / position**2
            rest = 1.0 - (leverage if weights is None else weights[rows] * leverage)
            parts.append((self._patch.value[rows] - sines @ solution) / rest.clamp_min(parameters.least_rest))
        misfit = torch.cat(parts).abs()
        deviation = max(position, float(misfit.median()) / 0.6745)
        return torch.minimum(ones, (parameters.robust_deviations * deviation / misfit.clamp_min(1e-300)).square())

    def log_evidence(self, position: float, angle: float) -> float:
        """Return the log marginal likelihood of the data, but for a term that no length changes.

        It is (|A^-1/2 b|^2 - log det A) / 2 with A = 1 + s^2 J^T D^-1 J and b = s J^T D^-1 y, or -infinity. Here the
        prior deviation is the RMS of the values: a wide one would favour long features. Free space is no data.
        Source: Rasmussen and Williams (2006), equation 2.30 in the space of the weights.
        """
        scale = self._scale / LocalSolveParameters.correction_rms_factor
        product, right = self._data_product(scale, position, angle), scale * self._data_right(position, angle)
        factor = damped_factor(product, torch.ones_like(right), overwrite=True)
        if factor is None:
            return -math.inf
        white = torch.linalg.solve_triangular(factor, right[:, None], upper=False)
        return 0.5 * float(white.square().sum()) - float(factor.diagonal().log().sum())

    def equations(self, position: float, angle: float) -> tuple[Tensor, Tensor] | None:
        """Return L, of shape (m, m), and b, of shape (m,), of that system L L^T a = b; None where it is indefinite."""
        factor, right = self._factored(position, angle)
        return None if factor is None else (factor / self._scale, right / self._scale)

    def _factored(self, position: float, angle: float) -> tuple[Tensor | None, Tensor]:
        """Return the Cholesky factor and the right-hand side for amplitudes over their standard deviation."""
        right = self._scale * (self._data_right(position, angle) + self._volume[1])
        return _factor(lambda: self._product(position, angle), right), right

    def _product(self, position: float, angle: float) -> Tensor:
        """Return s^2 J^T J in its lower triangle, in as few passes over the matrices as there are matrices."""
        return self._data_product(self._scale, position, angle).add_(self._volume[0], alpha=self._scale**2)

    def _data_product(self, scale: float, position: float, angle: float) -> Tensor:
        """Return that product of the data alone, for a standard deviation `scale` of the amplitudes."""
        product: Tensor = self._positions[0] * (scale / position) ** 2
        return product.add_(self._angles[0], alpha=(scale / angle) ** 2)

    def _data_right(self, position: float, angle: float) -> Tensor:
        """Return J^T D^-1 y of the data alone."""
        return self._positions[1] / position**2 + self._angles[1] / angle**2


class LocalRowSystem:
    """The same system in the space of its rows, for a patch of few points: K + 1 with K = s^2 J J^T.

    The most probable amplitudes are s^2 J^T (K + 1)^-1 r. Parameters are those of `PatchSystem`, but features take the
    precision of the patch.
    Source: Rasmussen and Williams (2006), equation 2.12.
    """

    def __init__(self, patch: Patch, features: Features, length: float, size: float) -> None:
        variance, features = size**2 * 2.0 / len(features), features.to(patch.value.dtype)
        sines, slopes = _data_rows(patch, features, length, slice(None))
        free, wanted = _volume_rows(patch, features, length, size)
        every = slice(None)
        slopes = [_weighted(patch.normal_weights, slope, every) for slope in slopes]
        turns = _weighted(patch.normal_weights, patch.gradient, every)
        rows = torch.cat([sines, *slopes, free])
        self._spread = variance * rows.T
        self._kernel = rows @ self._spread
        self._wanted = torch.cat([patch.value, turns.T.flatten(), wanted])
        self._counts = torch.tensor([len(sines), 3 * len(sines), len(free)], device=rows.device)

    def solve(self, position: float, angle: float) -> Tensor:
        """Return amplitudes, of shape (m,), as `PatchSystem.solve` does."""
        weights = self._wanted.new_tensor([1 / position, 1 / angle, 1.0]).repeat_interleave(self._counts)
        factor = _factor(lambda: (weights[:, None] * self._kernel).mul_(weights), weights)
        if factor is None:
            return torch.zeros_like(self._spread[:, 0])
        return self._spread @ (weights * solve_factored(factor, weights * self._wanted))


def data_kernel(patch: Patch, features: Features, length: float, size: float) -> Tensor:
    """Return the covariance of a correction's values and gradients at the points, of shape (4 N, 4 N).

    Gradients follow the values, axis by axis; parameters are those of `PatchSystem`.
    """
    sines, slopes = _data_rows(patch, features, length, slice(None))
    rows = torch.cat([sines, *slopes])
    return size**2 * 2.0 / len(features) * (rows @ rows.T)


def patch_system(patch: Patch, features: Features, length: float, size: float) -> PatchSystem | LocalRowSystem:
    """Return the smaller one of the two systems that `solve` may use; parameters as those of `PatchSystem`."""
    rows = 4 * len(patch.points) + len(patch.volume)
    by_rows = rows < len(features) and patch.weights is None
    return (LocalRowSystem if by_rows else PatchSystem)(patch, features, length, size)


def precise_enough(features: Features, points: int, length: float, size: float, noise: tuple[float, float]) -> Features:
    """Return the features in the precision that so many points need; other parameters as those of `PatchSystem`."""
    position, angle = size / noise[0], size / length / noise[1]
    # For features of variance one, a row of J has mean squares of one, for a value and each component of a normal.
    return features.precise_enough(points * (position**2 + 3 * angle**2))


def _weighted(weights: Tensor | None, values: Tensor, rows: slice) -> Tensor:
    """Return values of some points times the roots of the points' weights, if there are any."""
    if weights is None:
        return values
    roots = weights[rows].sqrt().to(values)
    return values * (roots if values.dim() == 1 else roots[:, None])


def _crowd(points: Tensor, reach: float) -> Tensor:
    """Return how many of the points, of shape (N, 3), lie within reach of each, with itself; of shape (N,)."""
    tree = cKDTree(points.cpu().numpy())
    return torch.as_tensor(tree.query_ball_point(tree.data, reach, return_length=True)).to(points)


def _factor(
    product: Callable[[], Tensor], like: Tensor, *, attempts: int = LocalSolveParameters.damping_attempts
) -> Tensor | None:
    """Return the Cholesky factor of a product plus the identity, or plus more where rounding requires it."""
    damping = torch.ones_like(like)
    for _ in range(attempts):
        factor = damped_factor(product(), damping, overwrite=True)
        if factor is not None:
            return factor
        damping = 10 * damping
    return None


def _data_rows(patch: Patch, features: Features, length: float, rows: slice) -> tuple[Tensor, list[Tensor]]:
    """Return the features at some points, of shape (N, m), and their derivatives along each axis."""
    z = features.phase(patch.points[rows], patch.center, length)
    sines, cosines = z.sin(), z.cos()
    return sines, [cosines * (features.frequencies[:, axis] / length) for axis in range(3)]


def _volume_rows(patch: Patch, features: Features, length: float, size: float) -> tuple[Tensor, Tensor]:
    """Return the features at the samples of the volume, of shape (Q, m), and their targets, over their deviation."""
    deviation = patch.deviation(length, size)
    return features.phase(patch.volume, patch.center, length).sin() / deviation[:, None], patch.wanted / deviation
