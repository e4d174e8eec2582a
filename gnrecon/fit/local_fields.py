"""Detail for a scan: what a global field leaves over is fitted in overlapping cubes, each by one linear solve.

A scan holds far more detail than one network can learn in reasonable time, and detail is local: the surface here says
nothing of the surface there. So a smooth global field gives the sign and closes holes, and each cube corrects it near
the data (`patch`) with a length and noise that the data itself chose (`choose`). The cubes are blended smoothly
(`field.partition`), so that the field stays one smooth function.
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
from gnrecon.fit.denoising import Told
from gnrecon.fit.field_model import NeuralSDF
from gnrecon.fit.local_solve import Belief, PatchSystem
from gnrecon.fit.model_selection import Leftover, Volume
from gnrecon.fit.regularised import Shaping
from gnrecon.geometry.arrays import Float, Int
from gnrecon.geometry.signed_distance import CoarseDistance
from gnrecon.runtime.parallel import map_in_threads
from gnrecon.runtime.progress import ProgressCallback, ignore_progress, subrange

_log = logging.getLogger(__name__)

ShapingFor = Callable[[float], Shaping]
"""Gives what is asked of the surface for features of a length, in radii."""

CELL = 5.0
"""Edge of a cube, in lengths."""

BEYOND = 2.0
"""How far a cube's data reaches beyond it, in radii of a point's disk."""

VOLUME, CLEAR = 400, 3.5
"""Samples of the volume a cube, and how far from the data they lie at least, in radii of a point's disk."""

LEAST_POINTS = 4
CHOSEN = 0.2
"""Share of the time after which length and noise are chosen."""

LONGER = 4.0
"""How much longer a cube's length may be, where points are sparse, than that of the whole scan."""


def fit_detail(
    sdf: NeuralSDF,
    told: Told,
    features: int,
    rng: np.random.Generator,
    device: str,
    advance: ProgressCallback = ignore_progress,
    shape: ShapingFor | None = None,
) -> Detail:
    """Return what to add to a global field.

    Parameters
    ----------
    sdf : the global field, in the samples' frame
    told : the samples, what the field leaves over at them, and what is believed about them
    features : number of features a cube
    rng : draws features and samples of the volume
    device : a torch device
    advance : told of the share that is done
    shape : gives what is asked of the surface besides, for the length of the detail
    """
    samples, leftover, belief = told.samples, told.leftover, told.belief
    _log.info(
        "Chosen for the detail: length %.3g radii, noise %.2g radii and %.2g radians; %d features a cube.",
        belief.length,
        belief.position,
        belief.angle,
        features,
    )
    coarse = CoarseDistance(samples.points, samples.normals, rng, leftover.density)
    shaping = None if shape is None else shape(belief.length)
    return _Cubes.of(leftover, belief, features, rng, device, shaping).detail(sdf, coarse, rng, advance)


def cube_length(belief: Belief, disks: Float, radius: float) -> float:
    """Return the length of a cube: longer where its points lie farther apart.

    Parameters
    ----------
    belief : of the whole scan
    disks : array of shape (N,), radii of the disks that the cube's points stand for
    radius : their median in the whole scan
    """
    return belief.length * min(max(float(np.median(disks) / radius), 1.0), LONGER)


@dataclass(frozen=True)
class _Cubes:
    """The cubes of a detail with the data that they are fitted to."""

    leftover: Leftover
    belief: Belief
    features: Features
    partition: Partition
    device: str
    shaping: Shaping | None

    @classmethod
    def of(
        cls,
        leftover: Leftover,
        belief: Belief,
        count: int,
        rng: np.random.Generator,
        device: str,
        shaping: Shaping | None,
    ) -> _Cubes:
        """Return the cubes of a belief's length, each of `count` features."""
        like = torch.zeros(0, dtype=torch.float64, device=device)
        cell = CELL * belief.length
        # Off the data by a part of a cell that no regular scan shares, so that no face of the lattice runs along it.
        partition = Partition(leftover.points.min(axis=0) - 0.137 * cell, cell)
        features = Features.draw(count, rng, like)
        return cls(leftover, belief, features, partition, device, shaping)

    def detail(
        self, sdf: NeuralSDF, coarse: CoarseDistance, rng: np.random.Generator, advance: ProgressCallback
    ) -> Detail:
        """Fit all cubes that hold data."""
        keys, _ = self.partition.members(self.leftover.points)
        volumes = self._volumes(sdf, coarse, keys, rng)
        reach = self.partition.reach + BEYOND * self.leftover.density.radius
        radius, disks = self.leftover.density.radius, self.leftover.density.disks

        def solved(number: int) -> tuple[float, Tensor] | None:
            """Return the length and amplitudes of a cube, or None where it holds too few points."""
            center = self.partition.center(keys[number])
            rows = self.leftover.within(center, reach)
            if len(rows) < LEAST_POINTS:
                return None
            length = cube_length(self.belief, disks[rows], radius)
            patch = self.leftover.patch(rows, center, volumes[number], self.device)
            return length, self._solved(PatchSystem(patch, self.features, length, patch.size), length, center)

        cubes = map_in_threads(solved, range(len(keys)), self.device, subrange(advance, CHOSEN, 1.0))
        kept = [number for number, cube in enumerate(cubes) if cube is not None]
        lengths, amplitudes = zip(*filter(None, cubes), strict=True)
        _log.info("Solved %d cubes of detail; %d held too few points.", len(kept), len(keys) - len(kept))
        noise = self.belief.position, self.belief.angle
        return Detail(self.partition, keys[kept], np.array(lengths), self.features, torch.stack(amplitudes), *noise)

    def _solved(self, system: PatchSystem, length: float, center: Float) -> Tensor:
        """Return the amplitudes of the cube about a centre, of shape (m,)."""
        if self.shaping is None:
            return system.solve_within(self.belief.position, self.belief.angle)
        return self.shaping.bend_cube(self.features, length, center, self.partition.reach, self.belief, system)

    def _volumes(self, sdf: NeuralSDF, coarse: CoarseDistance, keys: Int, rng: np.random.Generator) -> list[Volume]:
        """Return samples of each cube that lie clear of the data, with bounds that the coarse distance sets."""
        centers = self.partition.center(keys)
        x = centers[:, None, :] + self.partition.reach * rng.uniform(-1.0, 1.0, (len(keys), VOLUME, 3))
        cube = np.repeat(np.arange(len(keys)), VOLUME)
        x = x.reshape(-1, 3)
        inside = ((x > sdf.box.lower) & (x < sdf.box.upper)).all(axis=1)
        x, cube = x[inside], cube[inside]
        clear, signed, distance, certain = coarse.at(x, CLEAR)
        x, cube = x[clear], cube[clear]
        if self.shaping is not None:
            signed = self.shaping.told(x, signed)
        own = sdf.sdf(sdf.frame.to_world(x)) / sdf.frame.scale
        ends = np.searchsorted(cube, np.arange(1, len(keys)))
        parts = (np.split(values, ends) for values in (x, own, signed, certain, distance))
        return [Volume.around(*of_cube) for of_cube in zip(*parts, strict=True)]
