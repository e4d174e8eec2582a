"""Local fields: the residuals of the global field are fitted in overlapping cubes, each by one linear solve.

A scan holds far more detail than one network can learn in reasonable time, and detail is local: the surface in one
place does not depend on the surface in another. So a smooth global field gives the sign and closes holes, and each cube
corrects it near the data (`local_solve`), with a length scale and noise that validation points chose
(`model_selection`). The cubes are blended by a partition of unity (`field.partition_of_unity`).
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from gnrecon.field.cube_lattice import cube_groups
from gnrecon.field.partition_of_unity import Detail, Partition
from gnrecon.field.random_features import Features
from gnrecon.fit.field_model import NeuralSDF
from gnrecon.fit.free_space import CubeSpace, GroupSpace, Surroundings, has_gaps
from gnrecon.fit.global_field import FieldResiduals
from gnrecon.fit.local_solve import Patch, PatchSystem, precise_enough
from gnrecon.fit.model_selection import Hyperparameters, patch_likelihood
from gnrecon.fit.parameters import CoarserFieldParameters, LocalFieldParameters
from gnrecon.fit.penalties.surface_penalties import SurfacePenalties
from gnrecon.geometry.arrays import Float, Int
from gnrecon.runtime.parallel import map_in_threads
from gnrecon.runtime.progress import ProgressCallback, ignore_progress, subrange

_log = logging.getLogger(__name__)

PenaltiesFor = Callable[[float], SurfacePenalties]
"""Returns the curvature penalties for features of a length scale, in radii."""

SolveDetail = Callable[
    [NeuralSDF, FieldResiduals, Hyperparameters, int, np.random.Generator, str, ProgressCallback], Detail
]
"""Solves local fields; the arguments are the first ones of `fit_detail`."""


def fit_detail(
    sdf: NeuralSDF,
    residuals: FieldResiduals,
    hyperparameters: Hyperparameters,
    features: int,
    rng: np.random.Generator,
    device: str,
    advance: ProgressCallback = ignore_progress,
    shape: PenaltiesFor | None = None,
    *,
    solve: SolveDetail | None = None,
    parameters: LocalFieldParameters = LocalFieldParameters(),
) -> Detail:
    """Return the local fields that are added to a global field, with coarser ones where `with_coarser` adds some.

    Parameters
    ----------
    sdf : the global field, in the samples' frame
    residuals : of the global field at the samples
    hyperparameters : their length scale and noise
    features : number of features a cube
    rng : draws features and samples of the volume
    device : a torch device
    advance : called with the share that is done
    shape : gives the curvature penalties for the length scale of the local fields
    solve : solves them in other processes, where there are no penalties
    """
    _log.info(
        "Local fields: length scale %.3g radii, noise %.2g radii and %.2g radians; %d features each.",
        hyperparameters.length,
        hyperparameters.position,
        hyperparameters.angle,
        features,
    )
    advance = subrange(advance, parameters.selection_time_share, 1.0)
    penalties = None if shape is None else shape(hyperparameters.length)
    if penalties is not None:
        return _Cubes.of(sdf, residuals, hyperparameters, features, rng, device, penalties, parameters).detail(advance)
    sdf, residuals = with_coarser(sdf, residuals, hyperparameters, rng, device, parameters=parameters)
    fitted = sdf, residuals, hyperparameters, features, rng, device
    return _Cubes.of(*fitted, None, parameters).detail(advance) if solve is None else solve(*fitted, advance)


def with_coarser(
    sdf: NeuralSDF,
    residuals: FieldResiduals,
    hyperparameters: Hyperparameters,
    rng: np.random.Generator,
    device: str,
    *,
    parameters: LocalFieldParameters = LocalFieldParameters(),
) -> tuple[NeuralSDF, FieldResiduals]:
    """Return the global field with coarser local fields, where a clean scan needs them, and its residuals.

    They bridge gaps. And they bring the field so near to the surface of a dense scan that its cubes reach it: where the
    global field has its zero level beyond all of them, as between the legs of an animal, that stays as a wart.
    """
    for level in range(_coarser_levels(residuals, hyperparameters, rng.spawn(1)[0]), 0, -1):
        coarser = _coarser(sdf, residuals, hyperparameters, level, rng.spawn(1)[0], device, parameters)
        sdf, residuals = replace(sdf, detail=coarser), residuals.after(replace(coarser, coarser=None))
    return sdf, residuals


def _coarser_levels(
    residuals: FieldResiduals,
    hyperparameters: Hyperparameters,
    rng: np.random.Generator,
    *,
    parameters: CoarserFieldParameters = CoarserFieldParameters(),
) -> int:
    """Return how many levels of coarser corrections a scan needs, each of a longer length than the next.

    On a noisy scan they would add an error of their own, and noise hides the steps that they are to avoid.

    Parameters
    ----------
    residuals : at the points
    hyperparameters : of the scan
    rng : draws places in which gaps show
    """
    length, ratio = hyperparameters.length, parameters.length_ratio
    if len(residuals) < parameters.least_points or ratio * length > parameters.most_length_radii:
        return 0
    if residuals.rms < parameters.least_rms_noises * hyperparameters.position:
        return 0
    misfit = float(np.quantile(np.abs(residuals.value), 1.0 - parameters.far_share))
    if misfit > length:
        most = math.floor(math.log(parameters.most_length_radii / length, ratio))
        return min(math.ceil(math.log(misfit / length, ratio)), most)
    return int(has_gaps(residuals.points, residuals.density, residuals.dipoles, length, rng))


def _coarser(
    sdf: NeuralSDF,
    residuals: FieldResiduals,
    hyperparameters: Hyperparameters,
    level: int,
    rng: np.random.Generator,
    device: str,
    limits: LocalFieldParameters,
    *,
    parameters: CoarserFieldParameters = CoarserFieldParameters(),
) -> Detail:
    """Return local fields of a longer length, which grows with the level, fitted to a part of the points.

    What they do not resolve is noise to them. The likeliest noise is chosen, but no less than the scan's.
    """
    # As many points in a cube of each level.
    share = parameters.point_share / parameters.length_ratio ** (2 * (level - 1))
    some = residuals.take(np.flatnonzero(rng.random(len(residuals)) < share))
    length = parameters.length_ratio**level * hyperparameters.length
    position, angle = patch_likelihood(some, some.density.radius, rng, device).likeliest(length)
    position, angle = max(position, hyperparameters.position), max(angle, hyperparameters.angle)
    chosen = Hyperparameters(length, position, angle, robust=hyperparameters.robust)
    found = _Cubes.of(sdf, some, chosen, parameters.features, rng, device, None, limits).detail(ignore_progress)
    _log.info("Coarser local fields of length scale %.3g radii are fitted first.", length)
    return found


def cube_length(
    hyperparameters: Hyperparameters,
    disks: Float,
    radius: float,
    *,
    most_length_stretch: float = LocalFieldParameters.most_length_stretch,
) -> float:
    """Return the length scale of a cube: longer where its points lie farther apart.

    Parameters
    ----------
    hyperparameters : of the whole scan
    disks : array of shape (N,), radii of the disks that the cube's points stand for
    radius : their median in the whole scan
    most_length_stretch : most that a cube's length scale may exceed the scan's
    """
    return hyperparameters.length * min(max(float(np.median(disks) / radius), 1.0), most_length_stretch)


def feature_count(
    features: int,
    length: float,
    radius: float,
    *,
    usual_length_radii: float = 2.0,
    parameters: LocalFieldParameters = LocalFieldParameters(),
) -> int:
    """Return the number of features of each cube, which fill the space of its data as densely for short lengths.

    Parameters
    ----------
    features : of a cube of the usual length
    length : of the features
    radius : median of the disks' radii; a cube's data reaches some of these beyond it, which are more short lengths
    usual_length_radii : in these radii, at which and above there are as many features as that
    """

    def width(lengths_per_radius: float) -> float:
        inner = (1.0 + Partition.overlap) * parameters.cube_edge_lengths
        return inner + 2 * parameters.data_margin_disk_radii * lengths_per_radius

    return math.ceil(features * max(1.0, width(radius / length) / width(1.0 / usual_length_radii)) ** 3)


def solve_group(
    residuals: FieldResiduals,
    keys: Int,
    rows: Sequence[Int],
    around: Surroundings,
    partition: Partition,
    features: Features,
    hyperparameters: Hyperparameters,
    density: tuple[Float, float],
    device: str,
    penalties: SurfacePenalties | None = None,
    *,
    least_points: int = LocalFieldParameters.least_points,
    parameters: LocalFieldParameters = LocalFieldParameters(),
) -> list[tuple[float, Tensor] | None]:
    """Return the result of `solve_cube` for the cubes of a group, or None for one that holds too few points.

    Parameters
    ----------
    residuals, features, hyperparameters, device, penalties : as in `solve_cube`
    keys, rows : of the cubes, of shape (B, 3), and of the points that each is fitted to
    around : what the group's free space is measured with
    partition : whose cubes they are
    density : array of shape (N,), the radius of the disk that each point stands for, and the median of all
    least_points : of a cube
    """
    disks, radius = density
    solved = [number for number, some in enumerate(rows) if len(some) >= least_points]
    found: list[tuple[float, Tensor] | None] = [None] * len(keys)
    if not solved:
        return found
    stretch = parameters.most_length_stretch
    lengths = [cube_length(hyperparameters, disks[rows[n]], radius, most_length_stretch=stretch) for n in solved]
    space = GroupSpace.of(around, partition, keys[solved], lengths, hyperparameters.position)
    for number, length in zip(solved, lengths, strict=True):
        cube = residuals, rows[number], length, CubeSpace(space, keys[number]), features, hyperparameters, device
        found[number] = solve_cube(*cube, penalties, parameters=parameters)
    return found


def solve_cube(
    residuals: FieldResiduals,
    rows: Int,
    length: float,
    space: CubeSpace,
    features: Features,
    hyperparameters: Hyperparameters,
    device: str,
    penalties: SurfacePenalties | None = None,
    *,
    parameters: LocalFieldParameters = LocalFieldParameters(),
) -> tuple[float, Tensor]:
    """Return the length of a cube's features and their amplitudes, of shape (m,).

    Parameters
    ----------
    residuals, rows : of the global field at all points, and the rows of those that the cube is fitted to
    length : of its features, from which its own may differ if the hyperparameters say so
    space : around it
    features : of all cubes
    hyperparameters : of the whole scan
    device : a torch device
    penalties : of the surface's curvature, for features of the length as it is
    """
    patch = residuals.patch(rows, space.center, space.far(), device)
    position, angle = hyperparameters.position, hyperparameters.angle
    size = _prior_deviation(patch, length, hyperparameters)
    if penalties is None:
        # The likelihood of lengths has a prior of its own.
        features = precise_enough(features, len(patch.value), length, max(size, patch.size), (position, angle))
    if hyperparameters.by_place and penalties is None:
        length = _likeliest_length(patch, features, length, (position, angle), parameters)
    system = PatchSystem(patch, features, length, size)
    if hyperparameters.robust:
        system = system.reweighted(position, angle)
    near = space.near(length)
    if penalties is None:
        return length, system.solve_with_bounds(position, angle, near)
    return length, penalties.penalise_cube(features, length, space.center, space.reach, hyperparameters, system, near)


def _prior_deviation(patch: Patch, length: float, hyperparameters: Hyperparameters) -> float:
    """Return the prior standard deviation of a cube's correction.

    One of deviation s has slopes of deviation s / length along each axis. Where the global field is flat, as in a wall
    that it does not resolve, its values at the points are nearly right, and only their slopes ask for a correction.
    """
    asked = patch.rms
    if hyperparameters.by_slopes:
        asked = max(asked, length * float(patch.gradient.square().mean().sqrt()))
    return hyperparameters.rms_factor * asked


def _likeliest_length(
    patch: Patch, features: Features, length: float, noise: tuple[float, float], parameters: LocalFieldParameters
) -> float:
    """Return the length near a given one of which the cube's own data is most likely."""
    # Which of two lengths is likelier, a part of the features shows as well as all of them, in a fraction of the time.
    some = features.first(parameters.length_features)

    def likelihood(length: float) -> float:
        return PatchSystem(patch, some, length, patch.size).log_evidence(*noise)

    most = likelihood(length)
    for factor in (1 / parameters.length_step, parameters.length_step):
        start = length
        for _ in range(parameters.most_length_steps):
            if not (found := likelihood(factor * length)) > most:
                break
            length, most = factor * length, found
        if length != start:
            break
    return length


@dataclass(frozen=True)
class _Cubes:
    """The cubes of a detail with the data that they are fitted to, on a coarser detail if there is one."""

    sdf: NeuralSDF
    residuals: FieldResiduals
    around: Surroundings
    hyperparameters: Hyperparameters
    features: Features
    partition: Partition
    device: str
    penalties: SurfacePenalties | None
    parameters: LocalFieldParameters

    @classmethod
    def of(
        cls,
        sdf: NeuralSDF,
        residuals: FieldResiduals,
        hyperparameters: Hyperparameters,
        count: int,
        rng: np.random.Generator,
        device: str,
        penalties: SurfacePenalties | None,
        parameters: LocalFieldParameters,
    ) -> _Cubes:
        """Return the cubes of a length scale, each with `count` features."""
        like = torch.zeros(0, dtype=torch.float64, device=device)
        edge = parameters.cube_edge_lengths
        if penalties is None:
            count = feature_count(count, hyperparameters.length, residuals.density.radius, parameters=parameters)
        else:
            edge, count = parameters.penalised_edge_lengths, parameters.penalised_feature_ratio * count
        partition = Partition.about(residuals.points, edge * hyperparameters.length)
        features = Features.draw(count, rng, like)
        # Free space asks for no more than single precision.
        coarser = None if sdf.detail is None else sdf.detail.to(torch.float32)
        density, signed_by = residuals.density, None if penalties is None else penalties.volume_distances
        measured = residuals.dipoles, sdf.field, sdf.theta, coarser, signed_by
        around = Surroundings(sdf.box, density.tree, density.disks, *measured)
        return cls(sdf, residuals, around, hyperparameters, features, partition, device, penalties, parameters)

    def detail(self, advance: ProgressCallback) -> Detail:
        """Fit all cubes that hold data."""
        keys, _ = self.partition.members(self.residuals.points)
        groups = cube_groups(keys, self.parameters.group_cells)
        # One array for all: small ones between the large ones of a group would keep freed memory from being used again.
        lengths = np.full(len(keys), np.nan)
        amplitudes = self.features.phases.new_zeros(len(keys), len(self.features))

        def solve(rows: Int, *, least_points: int = LocalFieldParameters.least_points) -> None:
            for row, cube in zip(rows, self._solved(keys[rows], least_points), strict=True):
                if cube is not None:
                    lengths[row], amplitudes[row] = cube

        # In threads for a GPU too: the CPU looks for the points around a cube and sums their winding numbers.
        map_in_threads(solve, groups, advance=advance)
        if np.isnan(lengths).all():
            # A few points that are far apart: a cube of one is better than none.
            for rows in groups:
                solve(rows, least_points=1)
        kept = np.flatnonzero(np.isfinite(lengths))
        _log.info("Fitted %d local fields; %d cubes had too few points.", len(kept), len(keys) - len(kept))
        noise = self.hyperparameters.position, self.hyperparameters.angle
        fitted = keys[kept], lengths[kept], self.features, amplitudes[kept]
        return Detail(self.partition, *fitted, *noise, coarser=self.sdf.detail)

    def _solved(self, keys: Int, least_points: int) -> list[tuple[float, Tensor] | None]:
        """Return the length and amplitudes of each cube of a group, or None where it holds too few points."""
        density, limits = self.residuals.density, self.parameters
        reach = self.partition.reach + limits.data_margin_disk_radii * density.radius
        rows = [self.residuals.within(self.partition.center(key), reach) for key in keys]
        group = self.residuals, keys, rows, self.around, self.partition, self.features, self.hyperparameters
        rest = (density.disks, density.radius), self.device, self.penalties
        return solve_group(*group, *rest, least_points=least_points, parameters=limits)
