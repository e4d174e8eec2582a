"""The paper's loss on frozen points, as a least-squares problem of gnrecon, and the scans that it is measured on.

    1/2 mean f^2 + 1/2 mean (n . grad f - 1)^2 + 1e-2 * 1/2 mean (|grad f| - 1)^2

The first two means are over the scan's points, the last one over points of the volume. "Data loss" is the sum of the
first two; the paper's figures for scans are of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from benchmarks.accuracy.scans import PAPER_SCANS, draw_vertices, load_shape
from gnrecon.field import Siren
from gnrecon.fit.objective import FieldProblem, ObjectiveTerm
from gnrecon.residuals import eikonal, interface, normal_projection


class LossWeights(NamedTuple):
    """Weights of the three means; the defaults are the paper's."""

    data: float = 1.0
    normal: float = 1.0
    eikonal: float = 1e-2


PAPER_WEIGHTS = LossWeights()


@dataclass(frozen=True)
class Sample:
    """Points and unit normals, of shape (N, 3), and points of the volume, of shape (Q, 3), in unit coordinates."""

    points: Tensor
    normals: Tensor
    volume: Tensor

    @property
    def rows(self) -> tuple[int, int, int]:
        """Numbers of residuals of the three means."""
        return len(self.points), len(self.normals), len(self.volume)

    def to(self, device: str) -> Sample:
        """Return the same points on a device."""
        return Sample(self.points.to(device), self.normals.to(device), self.volume.to(device))


def posed(
    field: Siren,
    theta: Tensor,
    sample: Sample,
    precision: torch.dtype | None = None,
    keep_bytes: int = 1_500_000_000,
    weights: LossWeights = PAPER_WEIGHTS,
) -> FieldProblem:
    """Return the loss as a least-squares problem of all parameters at theta, of shape (p,).

    The factors of the Jacobian's rows are kept up to `keep_bytes`, and stored in `precision`.
    """
    terms = [
        ObjectiveTerm("data", interface, sample.points, None, weights.data),
        ObjectiveTerm("normal", normal_projection, sample.points, sample.normals, weights.normal),
        ObjectiveTerm("eikonal", eikonal, sample.volume, None, weights.eikonal),
    ]
    return FieldProblem(field, terms, theta, precision=precision, keep_bytes=keep_bytes)


def data_loss(field: Siren, theta: Tensor, sample: Sample) -> float:
    """Return the loss's first two means at theta, of shape (p,)."""
    value, gradient = field.value_and_gradient(theta, sample.points)
    along = (gradient * sample.normals).sum(1)
    return float(0.5 * value.square().mean() + 0.5 * (along - 1.0).square().mean())


def eikonal_error(field: Siren, theta: Tensor, sample: Sample) -> float:
    """Return the mean of (|grad f| - 1)^2 in the volume at theta, of shape (p,)."""
    _, gradient = field.value_and_gradient(theta, sample.volume)
    return float((torch.linalg.vector_norm(gradient, dim=1) - 1.0).square().mean())


def scan(case: str, data: Path, seed: int = 0) -> Sample:
    """Return one of the paper's scans, by its name in `PAPER_SCANS`, in float64.

    Raises
    ------
    InputError
        When the shape's file is missing or cannot be read.
    """
    chosen = PAPER_SCANS[case]
    points, normals = draw_vertices(load_shape(chosen.shape, data), chosen.fraction, seed)
    return surrounded(torch.as_tensor(points), torch.as_tensor(normals), seed=seed)


def sphere(count: int, volume_count: int, seed: int = 0) -> Sample:
    """Return `count` points of the unit sphere and `volume_count` of the volume."""
    normals = np.random.default_rng(seed).standard_normal((count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = torch.as_tensor(normals)
    return surrounded(points, points.clone(), volume_count, seed=seed)


def surrounded(
    points: Tensor, normals: Tensor, volume_count: int = 5000, *, seed: int, margin_radii: float = 0.2
) -> Sample:
    """Return points and normals, of shape (N, 3), with uniform points of the box around them.

    The number of points and the margin of the box are the paper's.
    """
    lower, upper = points.amin(0) - margin_radii, points.amax(0) + margin_radii
    generator = torch.Generator().manual_seed(seed)
    uniform = torch.rand(volume_count, 3, generator=generator, dtype=points.dtype)
    return Sample(points, normals, lower + uniform * (upper - lower))
