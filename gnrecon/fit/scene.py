"""What a fit is made in: the samples as tensors, their coarse distance, and the box around them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gnrecon.geometry.arrays import Float
from gnrecon.geometry.point_cloud import Samples
from gnrecon.geometry.signed_distance import Box, CoarseDistance, near_surface

MARGIN = 0.1
"""How far the box reaches beyond the data, in radii."""

VOLUME_COUNT = 10000
SHELL = 4.0
"""Standard deviation of the samples near the data, in spacings."""


REACH = 0.4
"""Length over which an angle of a normal counts as a height, in spacings."""


@dataclass(frozen=True)
class Scene:
    """Data points and normals, of shape (N, 3), on the device; the rest in numpy, for sampling.

    `reach` says what the normals are worth beside the points: see `REACH`.
    """

    points: Tensor
    normals: Tensor
    samples: Samples
    coarse: CoarseDistance
    box: Box
    volume_count: int = VOLUME_COUNT
    reach: float = REACH

    @classmethod
    def of(cls, samples: Samples, device: str, rng: np.random.Generator) -> Scene:
        """Put samples on a device."""
        points, normals = (torch.as_tensor(rows, device=device) for rows in (samples.points, samples.normals))
        coarse = CoarseDistance(samples.points, samples.normals, rng)
        return cls(points, normals, samples, coarse, _box(samples))

    def volume(self, count: int, rng: np.random.Generator) -> tuple[Float, Float]:
        """Return about `count` points of the box, (Q, 3), half of them near the data, and their coarse distances."""
        return self.coarse.sample(self.places(count, rng))

    def places(self, count: int, rng: np.random.Generator) -> Float:
        """Return such points, of shape (Q, 3), also where no distance is known because the data is too near."""
        shell = near_surface(self.samples.points, SHELL * self.coarse.spacing, count // 2, rng)
        inside = ((shell > self.box.lower) & (shell < self.box.upper)).all(axis=1)
        return np.concatenate([self.box.sample(count - count // 2, rng), shell[inside]])

    def tensor(self, values: Float) -> Tensor:
        """Return `values` as a tensor like the data's."""
        return torch.as_tensor(values).to(self.points)


def bounds_of(samples: Samples) -> Float:
    """Lower and upper corner of the box in which samples will be fitted, of shape (2, 3), file units."""
    box = _box(samples)
    return samples.frame.to_world(np.stack([box.lower, box.upper]))


def _box(samples: Samples) -> Box:
    return Box.around(samples.points, MARGIN)
