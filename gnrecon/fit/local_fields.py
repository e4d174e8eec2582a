"""Local fields: the residuals of the global field are fitted in overlapping cubes, each by one linear solve.

A scan holds far more detail than one network can learn in reasonable time, and detail is local: the surface in one
place does not depend on the surface in another. So a smooth global field gives the sign and closes holes, and each cube
corrects it near the data (`local_solve`), with a length scale and noise that validation points chose
(`model_selection`). The cubes are blended by a partition of unity (`field.partition_of_unity`).
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gnrecon.field.partition_of_unity import Detail, Partition
from gnrecon.field.random_features import Features
from gnrecon.fit.denoising import LocalData
from gnrecon.fit.field_model import NeuralSDF
from gnrecon.fit.local_solve import Hyperparameters, PatchSystem
from gnrecon.fit.model_selection import FieldResiduals, Volume
from gnrecon.fit.parameters import LocalFieldParameters
from gnrecon.fit.penalties.surface_penalties import SurfacePenalties
from gnrecon.geometry.arrays import Float, Int
from gnrecon.geometry.signed_distance import CoarseDistance
from gnrecon.runtime.parallel import map_in_threads
from gnrecon.runtime.progress import ProgressCallback, ignore_progress, subrange

_log = logging.getLogger(__name__)

PenaltiesFor = Callable[[float], SurfacePenalties]
"""Returns the curvature penalties for features of a length scale, in radii."""


def fit_detail(
    sdf: NeuralSDF,
    data: LocalData,
    features: int,
    rng: np.random.Generator,
    device: str,
    advance: ProgressCallback = ignore_progress,
    shape: PenaltiesFor | None = None,
    *,
    parameters: LocalFieldParameters = LocalFieldParameters(),
) -> Detail:
    """Return the local fields that are added to a global field.

    Parameters
    ----------
    sdf : the global field, in the samples' frame
    data : the samples, the residuals of the global field at them, and their length scale and noise
    features : number of features a cube
    rng : draws features and samples of the volume
    device : a torch device
    advance : called with the share that is done
    shape : gives the curvature penalties for the length scale of the local fields
    """
    samples, residuals, hyperparameters = data.samples, data.residuals, data.hyperparameters
    _log.info(
        "Local fields: length scale %.3g radii, noise %.2g radii and %.2g radians; %d features each.",
        hyperparameters.length,
        hyperparameters.position,
        hyperparameters.angle,
        features,
    )
    coarse = CoarseDistance(samples.points, samples.normals, rng, residuals.density)
    penalties = None if shape is None else shape(hyperparameters.length)
    cubes = _Cubes.of(residuals, hyperparameters, features, rng, device, penalties, parameters)
    return cubes.detail(sdf, coarse, rng, subrange(advance, parameters.selection_time_share, 1.0))


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


@dataclass(frozen=True)
class _Cubes:
    """The cubes of a detail with the data that they are fitted to."""

    residuals: FieldResiduals
    hyperparameters: Hyperparameters
    features: Features
    partition: Partition
    device: str
    penalties: SurfacePenalties | None
    parameters: LocalFieldParameters

    @classmethod
    def of(
        cls,
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
        cell = parameters.cube_edge_lengths * hyperparameters.length
        # Off the data by a part of a cell that no regular scan shares, so that no face of the lattice runs along it.
        partition = Partition(residuals.points.min(axis=0) - 0.137 * cell, cell)
        features = Features.draw(count, rng, like)
        return cls(residuals, hyperparameters, features, partition, device, penalties, parameters)

    def detail(
        self, sdf: NeuralSDF, coarse: CoarseDistance, rng: np.random.Generator, advance: ProgressCallback
    ) -> Detail:
        """Fit all cubes that hold data."""
        keys, _ = self.partition.members(self.residuals.points)
        volumes = self._volumes(sdf, coarse, keys, rng)
        reach = self.partition.reach + self.parameters.data_margin_disk_radii * self.residuals.density.radius
        radius, disks = self.residuals.density.radius, self.residuals.density.disks

        def solved(number: int) -> tuple[float, Tensor] | None:
            """Return the length and amplitudes of a cube, or None where it holds too few points."""
            center = self.partition.center(keys[number])
            rows = self.residuals.within(center, reach)
            if len(rows) < self.parameters.least_points:
                return None
            stretch = self.parameters.most_length_stretch
            length = cube_length(self.hyperparameters, disks[rows], radius, most_length_stretch=stretch)
            patch = self.residuals.patch(rows, center, volumes[number], self.device)
            return length, self._solved(PatchSystem(patch, self.features, length, patch.size), length, center)

        cubes = map_in_threads(solved, range(len(keys)), self.device, advance)
        kept = [number for number, cube in enumerate(cubes) if cube is not None]
        lengths, amplitudes = zip(*filter(None, cubes), strict=True)
        _log.info("Fitted %d local fields; %d cubes had too few points.", len(kept), len(keys) - len(kept))
        noise = self.hyperparameters.position, self.hyperparameters.angle
        return Detail(self.partition, keys[kept], np.array(lengths), self.features, torch.stack(amplitudes), *noise)

    def _solved(self, system: PatchSystem, length: float, center: Float) -> Tensor:
        """Return the amplitudes of the cube about a centre, of shape (m,)."""
        if self.penalties is None:
            return system.solve_with_bounds(self.hyperparameters.position, self.hyperparameters.angle)
        return self.penalties.penalise_cube(
            self.features, length, center, self.partition.reach, self.hyperparameters, system
        )

    def _volumes(self, sdf: NeuralSDF, coarse: CoarseDistance, keys: Int, rng: np.random.Generator) -> list[Volume]:
        """Return samples of each cube that lie clear of the data, with bounds that the coarse distance sets."""
        centers, count = self.partition.center(keys), self.parameters.volume_samples
        x = centers[:, None, :] + self.partition.reach * rng.uniform(-1.0, 1.0, (len(keys), count, 3))
        cube = np.repeat(np.arange(len(keys)), count)
        x = x.reshape(-1, 3)
        inside = ((x > sdf.box.lower) & (x < sdf.box.upper)).all(axis=1)
        x, cube = x[inside], cube[inside]
        clear, signed, distance, certain = coarse.at(x, self.parameters.clearance_disk_radii)
        x, cube = x[clear], cube[clear]
        if self.penalties is not None:
            signed = self.penalties.volume_distances(x, signed)
        own = sdf.sdf(sdf.frame.to_world(x)) / sdf.frame.scale
        ends = np.searchsorted(cube, np.arange(1, len(keys)))
        parts = (np.split(values, ends) for values in (x, own, signed, certain, distance))
        return [Volume.around(*of_cube) for of_cube in zip(*parts, strict=True)]
