"""What the engine is measured on: scans of the paper's shapes, and a sphere of any number of points."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from benchmarks.cases import CASES, draw, load
from benchmarks.engine.loss import Sample

VOLUME_COUNT = 5000
MARGIN = 0.2
"""The paper's points of the volume, and how far their box reaches beyond the scan, in radii."""


def scan(case: str, data: Path, seed: int = 0) -> Sample:
    """Return one of the paper's scans, by its name in `CASES`, in float64.

    Raises
    ------
    InputError
        When the shape's file is missing or cannot be read.
    """
    chosen = CASES[case]
    points, normals = draw(load(chosen.shape, data), chosen.fraction, seed)
    return surrounded(torch.as_tensor(points), torch.as_tensor(normals), VOLUME_COUNT, seed)


def sphere(count: int, volume_count: int, seed: int = 0) -> Sample:
    """Return `count` points of the unit sphere and `volume_count` of the volume."""
    normals = np.random.default_rng(seed).standard_normal((count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = torch.as_tensor(normals)
    return surrounded(points, points.clone(), volume_count, seed)


def surrounded(points: Tensor, normals: Tensor, volume_count: int, seed: int) -> Sample:
    """Return points and normals, of shape (N, 3), with uniform points of the box around them."""
    lower, upper = points.amin(0) - MARGIN, points.amax(0) + MARGIN
    generator = torch.Generator().manual_seed(seed)
    uniform = torch.rand(volume_count, 3, generator=generator, dtype=points.dtype)
    return Sample(points, normals, lower + uniform * (upper - lower))
