"""The variance of local detail: that of the most probable amplitudes' distribution, cube by cube.

Given the data in a cube, its correction is normal with the covariance that `patch` solves for; a point in several cubes
gets the blend of their standard deviations. What the data does not say of the correction, it does not say of the global
field either, which it would correct: the global field's own deviation counts by the share of the correction's that the
data has left, from almost nothing at the points to all of it where no cube reaches.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from gnrecon.cloud import Float, Samples
from gnrecon.field.detail import Detail
from gnrecon.fit.choose import Int, Leftover, Volume
from gnrecon.fit.detail import Cubes, left_over
from gnrecon.fit.patch import SIZE, Belief, Features, Patch, PatchSystem
from gnrecon.fit.sdf import NeuralSDF
from gnrecon.sampling import disk_radii

CHECKED, OUT, HOLE = 24, 6, 8
"""Cubes on which errors are checked: half without one point in so many, half without a hole of so many neighbours."""

COVERED = 0.9545
"""Share of a normal distribution within two standard deviations."""

ROWS = 4096


class Deviation(Protocol):
    """Standard deviations of a field's values."""

    def at(self, x: Float) -> Float:
        """Return them, of shape (N,), at x, of shape (N, 3), unit coordinates."""
        ...


@dataclass(frozen=True)
class DetailDeviation:
    """Standard deviations of a field with detail.

    Parameters
    ----------
    detail : Detail
    cubes : the data that it was fitted to
    coarse : of the global field
    """

    detail: Detail
    cubes: Cubes
    coarse: Deviation

    @classmethod
    def of(cls, sdf: NeuralSDF, samples: Samples, coarse: Deviation) -> DetailDeviation:
        """Gather what a field's detail was fitted to; `coarse` is the deviation of its global field."""
        detail = sdf.detail
        assert detail is not None
        leftover = left_over(sdf.coarse(), samples)
        tree = cKDTree(samples.points)
        belief = Belief(float(np.min(detail.lengths)), detail.position, detail.angle)
        features = Features(detail.frequencies, detail.phases)
        device = str(detail.phases.device)
        radii = disk_radii(samples.points, tree)
        cubes = Cubes(leftover, radii, tree, belief, features, detail.partition, device)
        return cls(detail, cubes, coarse)

    def at(self, x: Float) -> Float:
        """Return the standard deviation of the field, of shape (N,), at x, of shape (N, 3), unit coordinates."""
        keys, members = self.detail.partition.members(x)
        fitted = {tuple(key) for key in self.detail.keys.tolist()}
        blended, open_ = np.zeros(len(x)), np.ones(len(x))
        for key, rows in zip(keys, members, strict=True):
            if tuple(key.tolist()) not in fitted:
                continue
            center = self.detail.partition.center(key)
            of_cube = self._of_cube(self.cubes.rows(center), center)
            for start in range(0, len(rows), ROWS):
                some = rows[start : start + ROWS]
                points = torch.as_tensor(x[some])
                weight = next(self.detail.partition.weight(points, torch.as_tensor(center), 0)).numpy()
                deviation = of_cube.at(points.to(self.detail.phases))
                blended[some] += weight * deviation
                open_[some] -= weight * (1.0 - np.minimum(deviation / of_cube.size, 1.0))
        whole: Float = np.hypot(blended, np.clip(open_, 0.0, 1.0) * self.coarse.at(x))
        return whole

    def calibration(self, seed: int) -> float:
        """Return the factor, at least one, by which deviations must grow to cover what is left out; see `left_out`."""
        rng = np.random.default_rng(seed)
        scores = np.concatenate([np.zeros(1), *self._scores(rng)])
        return max(1.0, float(np.quantile(scores, COVERED)) / 2)

    def _scores(self, rng: np.random.Generator) -> Iterator[Float]:
        """Yield the errors of left-out points over their predicted deviations, cube by cube."""
        chosen = rng.permutation(len(self.detail))[:CHECKED]
        for number, cube in enumerate(chosen):
            center = self.detail.partition.center(self.detail.keys[cube])
            rows = self.cubes.rows(center)
            if len(rows) < 2 * HOLE:
                continue
            if number % 2:
                out = rng.permutation(len(rows))[: len(rows) // OUT]
            else:
                points = self.cubes.leftover.points[rows]
                out = cKDTree(points).query(points[rng.integers(len(rows))], HOLE)[1]
            kept = np.delete(rows, out)
            yield self._of_cube(kept, center).scores(self.cubes.leftover, rows[out], self.detail.position)

    def _of_cube(self, rows: Int, center: Float) -> _OfCube:
        patch = self.cubes.leftover.patch(rows, center, Volume.none(), self.cubes.device)
        length = self.cubes.length(rows)
        system = PatchSystem(patch, self.cubes.features, length)
        return _OfCube(patch, system, self.cubes.features, length, self.detail.position, self.detail.angle)


@dataclass(frozen=True)
class _OfCube:
    """The distribution of one cube's correction."""

    patch: Patch
    system: PatchSystem
    features: Features
    length: float
    position: float
    angle: float

    @property
    def size(self) -> float:
        """Standard deviation of the correction before any data is seen."""
        return SIZE * self.patch.size

    def at(self, x: Tensor) -> Float:
        """Return the standard deviation of the correction, of shape (N,), at x, of shape (N, 3)."""
        factor = self.system.factor(self.position, self.angle)
        sines = self.system.scale * self.features.phase(x, self.patch.center, self.length).sin()
        if factor is not None:
            sines = torch.linalg.solve_triangular(factor, sines.T, upper=False).T
        deviation: Float = sines.norm(dim=1).cpu().numpy()
        return deviation

    def scores(self, leftover: Leftover, rows: Int, noise: float) -> Float:
        """Return the errors at points that this cube has not seen, over their deviations, of shape (K,)."""
        x = torch.as_tensor(leftover.points[rows]).to(self.patch.value)
        z = self.features.phase(x, self.patch.center, self.length)
        amplitudes = self.system.solve(self.position, self.angle)
        error = leftover.value[rows] + (z.sin() @ amplitudes).cpu().numpy()
        scores: Float = np.abs(error) / np.sqrt(self.at(x) ** 2 + noise**2)
        return scores
