"""The terms of a fit, drawn afresh for each step.

In the paper's Monte Carlo form (weights on mean squares, unit coordinates, h the spacing of the data):

    interface   f = 0                  at the points        1
    normal      grad f = n             at the points        max(r h, 0.012)^2, an angle as a height over that length;
                                                            r is the scene's reach, 0.4 where nothing chose it
    distance    f = coarse distance    in the box           max(1e-4 M / N, 4e-4), M samples and N points
    eikonal     |grad f| = 1           near the surface     (0.05 h)^2
                                       and in the box
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from gnrecon.fit.options import FitOptions, normal_residual
from gnrecon.fit.scene import REACH, Scene
from gnrecon.fit.terms import Term
from gnrecon.geometry.signed_distance import near_surface
from gnrecon.residuals.constraints import eikonal, interface, signed_distance

LEAST_REACH = 0.012
EIKONAL_REACH = 0.05
DISTANCE_ROW, DISTANCE_WEIGHT = 1e-4, 4e-4
EIKONAL_COUNT = 3000
LINEAR = ("vector", "projection")
"""Residuals of normals that are linear in the field."""


def start_terms(
    scene: Scene, options: FitOptions, rng: np.random.Generator, x: Tensor, distance: Tensor, most: int
) -> list[Term]:
    """Return the terms of a linear start: at most `most` data points, and volume samples x with their distances."""
    # The start is a linear solve, and other residuals than these two are not linear in f, or not known to be.
    linear = options if options.normals in LINEAR else replace(options, normals="vector")
    return [*data_terms(scene, linear, rng, most), distance_term(scene, x, distance)]


def step_terms(
    scene: Scene,
    options: FitOptions,
    rng: np.random.Generator,
    volume: tuple[Tensor, Tensor],
    most: int,
    data_weight: float = 1.0,
) -> list[Term]:
    """Draw the terms of one step: at most `most` data points, with `data_weight` times their weight, and the volume.

    Parameters
    ----------
    volume : samples, of shape (Q, 3), and their coarse distances, of shape (Q,)
    """
    eikonal_count = min(EIKONAL_COUNT, most)
    near = near_surface(scene.samples.points, 2 * scene.coarse.spacing, eikonal_count, rng)
    around = np.concatenate([near, scene.box.sample(eikonal_count // 3, rng)])
    eikonal_weight = (EIKONAL_REACH * scene.coarse.spacing) ** 2 * data_weight**0.5
    return [
        *data_terms(scene, options, rng, most, data_weight),
        distance_term(scene, *volume),
        Term("eikonal", eikonal, scene.tensor(around), None, eikonal_weight),
    ]


def data_terms(
    scene: Scene, options: FitOptions, rng: np.random.Generator, most: int, weight: float = 1.0
) -> list[Term]:
    """Return interface and normals at the data points, or at `most` of them drawn afresh."""
    points, normals = scene.points, scene.normals
    if len(points) > most:
        rows = torch.as_tensor(np.sort(rng.permutation(len(points))[:most])).to(points.device)
        points, normals = points[rows], normals[rows]
    beside = normal_weight(scene.coarse.spacing, scene.reach)
    return [
        Term("interface", interface, points, None, weight),
        Term("normal", normal_residual(options.normals), points, normals, weight * beside),
    ]


def normal_weight(spacing: float, reach: float = REACH) -> float:
    """Return the weight of normals beside that of the interface, for data of a spacing in radii."""
    return max(reach * spacing, LEAST_REACH) ** 2


def distance_term(scene: Scene, x: Tensor, distance: Tensor) -> Term:
    """The sparser the data, the more the free space must be told; the denser, the steeper a fit can turn in it."""
    weight = max(DISTANCE_ROW * len(x) / len(scene.points), DISTANCE_WEIGHT)
    return Term("distance", signed_distance, x, distance, weight)
