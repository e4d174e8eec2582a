"""A start of our own for deep networks: random sine features, their last layer solved for.

The first layer's frequencies are normal with deviation OMEGA, its phases uniform; the inner layers' weights uniform
within sqrt(6 / fan-in), their phases within pi. The last layer then fits  f = 0,  grad f = n  and coarse signed
distances in the volume by least squares with a ridge.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from benchmarks.engine.loss import Sample
from gnrecon.field import Siren
from gnrecon.fit.initialisation import solve_last_layer
from gnrecon.fit.objective import ObjectiveTerm, Scene
from gnrecon.geometry.point_cloud import Frame, Samples
from gnrecon.residuals import interface, normal_vector, signed_distance

OMEGA = 6.0
RIDGE = 1e-4
POINTS = 3000
NORMAL_WEIGHT, DISTANCE_WEIGHT = 0.1, 0.1


def sine_features(field: Siren, seed: int) -> Tensor:
    """Return theta, of shape (p,), its last layer zero."""
    generator = torch.Generator().manual_seed(seed)
    layers = []
    for level, (out, into) in enumerate(field.layout.shapes):
        phases = math.pi * uniform(out, 1, generator)[:, 0]
        weights = math.sqrt(6.0 / into) * uniform(out, into, generator)
        if level == 0:
            weights = OMEGA * torch.randn(out, into, generator=generator, dtype=torch.float64)
        layers.append((weights, phases))
    layers[-1] = (torch.zeros_like(layers[-1][0]), torch.zeros_like(layers[-1][1]))
    return field.layout.flatten(layers)


def uniform(rows: int, columns: int, generator: torch.Generator) -> Tensor:
    """Return numbers within -1 and 1, of shape (rows, columns)."""
    return 2 * torch.rand(rows, columns, generator=generator, dtype=torch.float64) - 1


def solved_start(field: Siren, sample: Sample, seed: int = 0) -> Tensor:
    """Return theta, of shape (p,), whose last layer fits the sample."""
    rng = np.random.default_rng(seed)
    points, normals = sample.points.cpu().numpy(), sample.normals.cpu().numpy()
    scene = Scene.of(Samples(points, normals, Frame(np.zeros(3), 1.0)), "cpu", rng)
    x, distance = scene.volume(POINTS, rng)
    chosen = torch.as_tensor(rng.permutation(len(points))[:POINTS])
    on = scene.points[chosen]
    terms = [
        ObjectiveTerm("data", interface, on),
        ObjectiveTerm("normal", normal_vector, on, scene.normals[chosen], NORMAL_WEIGHT),
        ObjectiveTerm("distance", signed_distance, scene.tensor(x), scene.tensor(distance), DISTANCE_WEIGHT),
    ]
    return solve_last_layer(field, terms, sine_features(field, seed), RIDGE).to(sample.points)
