"""The paper's loss on frozen points, as our engine sees it.

    1/2 mean f^2 + 1/2 mean (n . grad f - 1)^2 + 1e-2 * 1/2 mean (|grad f| - 1)^2

The first two means are over the scan's points, the last one over points of the volume. "Data loss" is the sum of the
first two, which the paper's figures for scans are of.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gnrecon.field import Siren
from gnrecon.fit.objective import FieldProblem, ObjectiveTerm
from gnrecon.residuals import eikonal, interface, normal_projection

WEIGHTS = (1.0, 1.0, 1e-2)
"""Of the data, the normals and the eikonal constraint."""

KEEP_BYTES = 1_500_000_000


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
    keep_bytes: int = KEEP_BYTES,
    weights: tuple[float, float, float] = WEIGHTS,
) -> FieldProblem:
    """Return the loss as a least-squares problem of all parameters at theta, of shape (p,)."""
    data, normal, volume = weights
    terms = [
        ObjectiveTerm("data", interface, sample.points, None, data),
        ObjectiveTerm("normal", normal_projection, sample.points, sample.normals, normal),
        ObjectiveTerm("eikonal", eikonal, sample.volume, None, volume),
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
