"""Normals as unknowns: those of the smoothest surface through the points, where noise is not likelier.

Of all functions that are zero at k points and have given gradients g there, of shape (3k,), the triharmonic spline has
the least energy, the integral of its squared third derivatives. That energy is a quadratic form g^T J g, so that the
smoothest surface through points of unknown normals has the unit vectors of its minimum. Here the forms are those of
patches of nearest points, which overlap: the minimum of their sum is one of the surface as a whole, in linear time.

The spline is also the mean of a Gaussian process with the covariance c |x - y|^3, up to linear functions. With noise of
deviation s of the positions, the values of a patch have the covariance c (K + r I) with r = s^2 / c, and J is that part
of its inverse which belongs to the gradients. The normals are integrated out about the minimum (Laplace's method):

    log p = -1/2 ((m - 2k) log c + log det A + g^T J g / c + log det H) + constant,

where A is the covariance of the m = 4k - 4 combinations of values and gradients that no linear function changes, for
c = 1, and H the energy's Hessian in the tangent planes. Each patch has the amplitude c that is likeliest: with one for
all, thin parts of a sparse scan, which curve more than the others, would pass for noise. Points are exact where no
noise makes the sum over all patches larger. Of some hundred points, no surface that was fitted first shows this: what
it leaves over is as irregular as noise where the spacing is that of the shape's features.

How sure a point's normal is, the patch about it says: the inverse of H is the covariance of its normals about the
minimum, and the part of it that belongs to one point has all others integrated out.

Sources: Huang, Carr and Ju, *Variational Implicit Point Set Surfaces* (ACM TOG 2019), for the energy and its unit
normals; Rasmussen and Williams, *Gaussian Processes for Machine Learning* (2006), sections 2.7 and 3.4; Varin, Reid and
Firth, *An overview of composite likelihood methods* (2011), for sums over patches that overlap.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.optimize import minimize
from scipy.spatial import cKDTree

from gnrecon.geometry.arrays import Float, Int
from gnrecon.geometry.statistics import perpendicular
from gnrecon.runtime.chunks import slices


@dataclass(frozen=True)
class SplineParameters:
    """Tuning constants of `smoothest_normals`."""

    most_points: int = 6000  # of a scan whose normals are found, as their forms take 250 MB
    patch_points: int = 16  # with 12 normals are off by a twentieth more, with 20 by a fiftieth less
    group_patches: int = 128  # handled at a time, in one thread
    noises_disk_radii: tuple[float, ...] = (0.14, 0.4)  # that are compared with none; below 0.07, none is likelier
    ratios: tuple[float, ...] = tuple(10.0**step for step in range(-7, 2))  # of the noise's and the spline's variance,
    # in a patch of radius one; below the first, rounding would decide
    least_amplitude: float = 1e-6  # of a patch of radius one: that of heights of a thousandth; planes have none
    gradient_variance: float = 0.01  # over the amplitude, in such a patch, for points that nearly coincide
    least_precision: float = 1.0  # per squared radian: a normal that nothing determines is one radian off
    regions: int = 8  # whose patches show the noise
    region_points: int = 125
    rounds: int = 2  # of amplitudes for these normals, and normals for these amplitudes
    iterations: int = 50  # of each minimisation


@dataclass(frozen=True)
class SmoothestNormals:
    """Normals of the smoothest surface through points.

    Parameters
    ----------
    normals : array of shape (N, 3), unit vectors
    deviations : array of shape (N,), their standard deviations along each tangent, radians
    """

    normals: Float
    deviations: Float


def smoothest_normals(
    points: Float, normals: Float, *, parameters: SplineParameters = SplineParameters()
) -> SmoothestNormals | None:
    """Return the normals of the smoothest surface through points, or None where noise is likelier.

    Parameters
    ----------
    points : array of shape (N, 3), distinct, N >= 10
    normals : array of shape (N, 3), unit vectors, a first guess, which decides the side
    parameters : tuning constants
    """
    scaled = _scaled(points)
    centers = _regions(scaled, parameters)
    found = _exact_fit(scaled, normals, centers, parameters)
    if found is None:
        return None
    patches, exact = found
    if len(centers) < len(points):
        patches = _SplinePatches(scaled, np.arange(len(points)), parameters)
        exact = patches.fit(normals, 0.0)
    return SmoothestNormals(exact.normals, patches.deviations(exact))


def are_exact(points: Float, normals: Float, *, parameters: SplineParameters = SplineParameters()) -> bool:
    """Return whether noise is no likelier than none, in some regions of the scan.

    The parameters are those of `smoothest_normals`.
    """
    scaled = _scaled(points)
    return _exact_fit(scaled, normals, _regions(scaled, parameters), parameters) is not None


def _exact_fit(
    points: Float, normals: Float, centers: Int, parameters: SplineParameters
) -> tuple[_SplinePatches, _Fit] | None:
    """Return the patches about some points and their fit without noise, or None where noise is likelier."""
    # The patches about the centers have no other points than these.
    used = np.unique(_nearest(points, centers, parameters)[1])
    patches, normals = _SplinePatches(points[used], np.searchsorted(used, centers), parameters), normals[used]
    exact = patches.fit(normals, 0.0)
    for noise in parameters.noises_disk_radii:
        if patches.fit(normals, noise * patches.radius).log_likelihood > exact.log_likelihood:
            return None
    return patches, exact


def _scaled(points: Float) -> Float:
    """Return the points in a cube of edge two about their mean."""
    centred = points - points.mean(axis=0)
    scaled: Float = centred / np.abs(centred).max()
    return scaled


def _nearest(points: Float, centers: Int, parameters: SplineParameters) -> tuple[Float, Int]:
    """Return the distances and rows of the points of the patches about some, of shape (B, k), nearest first."""
    ranks = list(range(1, min(parameters.patch_points, len(points)) + 1))
    distance, near = cKDTree(points).query(points[centers], ranks)
    return np.asarray(distance), np.asarray(near)


def _regions(points: Float, parameters: SplineParameters) -> Int:
    """Return the rows of all points, or of those in some random regions, if they are many; in order."""
    if len(points) <= parameters.regions * parameters.region_points:
        return np.arange(len(points))
    centers = points[np.random.default_rng(0).choice(len(points), parameters.regions, replace=False)]
    return np.unique(cKDTree(points).query(centers, parameters.region_points)[1])


# Ratio, amplitude and log likelihood of some patches, each of shape (B,).
_Likeliest = tuple[Float, Float, Float]


@dataclass(frozen=True)
class _Fit:
    """Unit normals of least energy, of shape (N, 3), and of each group the likeliest of its patches for them."""

    normals: Float
    likeliest: list[_Likeliest]

    @property
    def log_likelihood(self) -> float:
        """Of the normals, but for a constant."""
        return sum(float(density.sum()) for _, _, density in self.likeliest)


class _SplinePatches:
    """The energies of the patches about some points.

    Parameters
    ----------
    points : array of shape (N, 3)
    centers : rows of the points that have a patch
    parameters : as of `smoothest_normals`
    """

    def __init__(self, points: Float, centers: Int, parameters: SplineParameters) -> None:
        from gnrecon.runtime.parallel import map_in_threads  # it loads torch

        self._map = map_in_threads
        self.parameters = parameters
        distance, near = _nearest(points, centers, parameters)
        reach = distance[:, -1]
        self.radius = float(np.median(reach)) / near.shape[1] ** 0.5
        """Of the disk that a point stands for, in the unit of the points."""
        groups = slices(len(centers), parameters.group_patches)
        self._groups = self._map(lambda rows: _Group(points, near[rows], reach[rows], parameters), groups)

    def fit(self, normals: Float, noise: float) -> _Fit:
        """Return the normals of least energy for a noise of the positions.

        Parameters
        ----------
        normals : of shape (N, 3), unit vectors to start at
        noise : standard deviation, in the unit of the points
        """
        for _ in range(self.parameters.rounds):
            pairs = list(zip(self._groups, self._likeliest(normals, noise), strict=True))
            normals = self._minimum(self._map(lambda pair: pair[0].form(*pair[1][:2]), pairs), normals)
        return _Fit(normals, self._likeliest(normals, noise))

    def deviations(self, fit: _Fit) -> Float:
        """Return the standard deviations of a fit's normals, of shape (N,), where all points are centers."""
        pairs = list(zip(self._groups, fit.likeliest, strict=True))
        variances = self._map(lambda pair: pair[0].first_variances(fit.normals, *pair[1][:2]), pairs)
        deviations: Float = np.sqrt(np.concatenate(variances))
        return deviations

    def _likeliest(self, normals: Float, noise: float) -> list[_Likeliest]:
        """Return the likeliest of the patches of each group."""
        return self._map(lambda group: group.likeliest(normals, noise), self._groups)

    def _minimum(self, forms: list[Float], normals: Float) -> Float:
        """Return the unit vectors at which the sum of quadratic forms is least, near those of a start."""
        both = list(zip(self._groups, forms, strict=True))

        def energy(flat: Float) -> tuple[float, Float]:
            vectors = flat.reshape(-1, 3)
            length = np.linalg.norm(vectors, axis=1, keepdims=True)
            unit = vectors / length
            slope = np.sum(self._map(lambda one: one[0].derivative(one[1], unit), both), axis=0)
            along = (slope * unit).sum(axis=1, keepdims=True)
            # Lengths do not count. The forms are quadratic: their value is the product with half of their derivative.
            return float(along.sum()), (2 * (slope - along * unit) / length).ravel()

        limits = {"maxiter": self.parameters.iterations}
        vectors: Float = minimize(energy, normals.ravel(), jac=True, method="L-BFGS-B", options=limits).x.reshape(-1, 3)
        unit: Float = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
        return unit


class _Group:
    """The quadratic forms of some patches, each in coordinates in which its radius is one."""

    def __init__(self, points: Float, near: Int, reach: Float, parameters: SplineParameters) -> None:
        self.parameters = parameters
        self.near, self.reach, self.count = near, reach, len(points)
        k = near.shape[1]
        local = points[near]
        local = (local - local.mean(axis=1, keepdims=True)) / reach[:, None, None]
        system = _spline_system(local)
        rows = np.arange(4 * k)
        system[:, rows, rows] += np.where(rows < k, parameters.ratios[0], parameters.gradient_variance)
        linear = system[:, : 4 * k, 4 * k :]
        # The determinant of the whole system is that of A, times that of the linear functions' products.
        self.log_det = np.linalg.slogdet(system)[1] - np.linalg.slogdet(linear.transpose(0, 2, 1) @ linear)[1]
        inverse = np.linalg.inv(system)
        self._of_values = inverse[:, :k, : 4 * k].copy()
        self.least = inverse[:, k : 4 * k, k : 4 * k].copy()

    @cached_property
    def _modes(self) -> tuple[Float, Float]:
        """The eigenvalues of J_ff, of shape (B, k), and J_fg along its eigenvectors, of shape (B, k, 3k).

        A ratio r changes the values' diagonal alone: J - J_gf (1 / r + J_ff)^-1 J_fg. Without noise, it has no effect.
        """
        k = self.near.shape[1]
        values, axes = np.linalg.eigh(self._of_values[:, :, :k])
        return np.maximum(values, 0.0), axes.transpose(0, 2, 1) @ self._of_values[:, :, k:]

    def likeliest(self, normals: Float, noise: float) -> _Likeliest:
        """Return the likeliest ratio, the amplitude and the log likelihood of each patch, of shape (B,)."""
        k = self.near.shape[1]
        freedom = 4 * k - 4 - 2 * k
        flat = normals[self.near].reshape(len(self.near), -1)
        planes = self._tangent_planes(normals)
        hessian = planes.transpose(0, 2, 1) @ (self.least @ planes)
        log_hessian = np.linalg.slogdet(hessian)[1]
        energy = (flat * (self.least @ flat[:, :, None])[:, :, 0]).sum(axis=1)
        if not noise:
            # The ratio is the least one, and the amplitude is free.
            amplitudes = np.maximum(energy / freedom, self.parameters.least_amplitude)
            density = freedom * np.log(amplitudes) + self.log_det + energy / amplitudes + log_hessian
            return np.full(len(flat), self.parameters.ratios[0]), amplitudes, -0.5 * density
        values, mixed = self._modes
        off = mixed @ planes
        less = off @ np.linalg.solve(hessian, off.transpose(0, 2, 1))
        squares = (mixed @ flat[:, :, None])[:, :, 0] ** 2
        best = np.full(len(flat), -np.inf)
        ratios, amplitudes = np.full(len(flat), self.parameters.ratios[0]), np.ones(len(flat))
        for ratio in self.parameters.ratios:
            share = self._share(np.full(len(flat), ratio))
            rest = energy - (share * squares).sum(axis=1)
            amplitude = np.maximum((noise / self.reach) ** 2 / ratio, self.parameters.least_amplitude)
            root = np.sqrt(share)
            lost = np.linalg.slogdet(np.eye(k) - root[:, :, None] * less * root[:, None, :])[1]
            log_det = self.log_det + np.log1p((ratio - self.parameters.ratios[0]) * values).sum(axis=1)
            density = -0.5 * (freedom * np.log(amplitude) + log_det + rest / amplitude + log_hessian + lost)
            better = density > best
            best, ratios = np.where(better, density, best), np.where(better, ratio, ratios)
            amplitudes = np.where(better, amplitude, amplitudes)
        return ratios, amplitudes, best

    def form(self, ratios: Float, amplitudes: Float) -> Float:
        """Return the energies' quadratic forms over their amplitudes, of shape (B, 3k, 3k)."""
        forms, shares = self.least, self._share(ratios)
        if shares.any():
            mixed = self._modes[1]
            forms = forms - mixed.transpose(0, 2, 1) @ (mixed * shares[:, :, None])
        return forms / amplitudes[:, None, None]

    def first_variances(self, normals: Float, ratios: Float, amplitudes: Float) -> Float:
        """Return the variance of each patch's first normal along a tangent, of shape (B,), squared radians."""
        k, count = self.near.shape[1], len(self.near)
        forms, planes, unit = self.form(ratios, amplitudes), self._tangent_planes(normals), normals[self.near]
        slope = (forms @ unit.reshape(count, -1, 1)).reshape(count, k, 3)
        hessian = planes.transpose(0, 2, 1) @ (forms @ planes)
        # On the sphere, a gradient along the normal curves the energy, too.
        hessian[:, range(2 * k), range(2 * k)] -= np.repeat((slope * unit).sum(axis=2), 2, axis=1)
        precisions, axes = np.linalg.eigh(hessian)
        precisions = np.maximum(precisions, self.parameters.least_precision)
        variances: Float = (axes[:, :2] ** 2 / precisions[:, None]).sum(axis=2).mean(axis=1)
        return variances

    def _tangent_planes(self, normals: Float) -> Float:
        """Return two tangents of each normal as columns of shape (B, 3k, 2k), for products with forms."""
        k = self.near.shape[1]
        blocks = np.zeros((len(self.near), k, 3, k, 2))
        blocks[:, range(k), :, range(k)] = _tangents(normals)[self.near].transpose(1, 0, 3, 2)
        return blocks.reshape(len(self.near), 3 * k, 2 * k)

    def derivative(self, forms: Float, normals: Float) -> Float:
        """Return half of the derivative of the sum of quadratic forms by all normals, of shape (N, 3)."""
        flat = normals[self.near].reshape(len(self.near), -1, 1)
        parts, rows = (forms @ flat).reshape(-1, 3), self.near.ravel()
        return np.stack([np.bincount(rows, parts[:, axis], self.count) for axis in range(3)], axis=1)

    def _share(self, ratios: Float) -> Float:
        """Return what ratios of shape (B,) subtract from a form along the eigenvectors of J_ff, of shape (B, k)."""
        more = (ratios - self.parameters.ratios[0])[:, None]
        if not more.any():
            return np.zeros(self.near.shape)
        shares: Float = more / (1.0 + more * self._modes[0])
        return shares


def _spline_system(points: Float) -> Float:
    """Return the covariances of values, gradients and linear functions at points of shape (B, k, 3).

    The rows of the answer, of shape (B, 4k + 4, 4k + 4), are the values, the gradients of each point, and the
    coefficients of the linear functions. The covariance is |x - y|^3.
    """
    count, k = points.shape[:2]
    offset = points[:, :, None] - points[:, None]
    distance = np.sqrt((offset**2).sum(axis=3))
    outer = offset[..., :, None] * offset[..., None, :] / np.where(distance > 0, distance, 1.0)[..., None, None]
    system = np.zeros((count, 4 * k + 4, 4 * k + 4))
    system[:, :k, :k] = distance**3
    slope = (3 * distance[..., None] * offset).reshape(count, k, 3 * k)
    system[:, :k, k : 4 * k] = -slope
    second = -3 * (distance[..., None, None] * np.eye(3) + outer)
    system[:, k : 4 * k, k : 4 * k] = second.transpose(0, 1, 3, 2, 4).reshape(count, 3 * k, 3 * k)
    system[:, :k, 4 * k] = 1.0
    system[:, :k, 4 * k + 1 :] = points
    system[:, k : 4 * k, 4 * k + 1 :] = np.tile(np.eye(3), (k, 1))
    upper = np.triu(np.ones(system.shape[1:], dtype=bool), 1)
    symmetric: Float = np.where(upper, system, system.transpose(0, 2, 1))
    return symmetric


def _tangents(normals: Float) -> Float:
    """Return two unit vectors across each unit normal, of shape (N, 2, 3)."""
    first = perpendicular(normals)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    both: Float = np.stack([first, np.cross(normals, first)], axis=1)
    return both
