"""What a fit is made in: the samples as tensors, their coarse distance, and the box around them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from gnrecon.cloud import Samples
from gnrecon.sampling import Box, CoarseDistance

MARGIN = 0.1
"""How far the box reaches beyond the data, in radii."""

VOLUME_COUNT = 4000


@dataclass(frozen=True)
class Scene:
    """Data points and normals, of shape (N, 3), on the device; the rest in numpy, for sampling."""

    points: Tensor
    normals: Tensor
    samples: Samples
    coarse: CoarseDistance
    box: Box
    volume_count: int = VOLUME_COUNT

    @classmethod
    def of(cls, samples: Samples, device: str, rng: np.random.Generator) -> Scene:
        """Put samples on a device."""
        points, normals = (torch.as_tensor(rows, device=device) for rows in (samples.points, samples.normals))
        coarse = CoarseDistance(samples.points, samples.normals, rng)
        return cls(points, normals, samples, coarse, Box.around(samples.points, MARGIN))

    def tensor(self, values: npt.NDArray[np.float64]) -> Tensor:
        """Return `values` as a tensor like the data's."""
        return torch.as_tensor(values).to(self.points)
