"""Estimated normals that a fitted field contradicts, turned around.

A field that is zero at the points and follows the coarse signed distance in free space needs no normals: a small patch
of them on the wrong side hardly changes the winding number from which that distance has its sign, so that the field's
gradient there points clearly against them. Where it only wavers, as in a thin wall that it does not resolve, its
gradient is short, and the normals stay. The same again with the turned normals is iterated Poisson reconstruction (Hou
et al., *Iterative Poisson Surface Reconstruction for Unoriented Points*, ACM TOG 2022) with this fit instead.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from gnrecon.field.networks import Siren
from gnrecon.fit.loss import distance_term
from gnrecon.fit.options import FitOptions
from gnrecon.fit.scene import Scene
from gnrecon.fit.sdf import NeuralSDF
from gnrecon.fit.smoothness import LENGTHS, smooth_spectrum
from gnrecon.fit.start import wide_start
from gnrecon.fit.terms import Term
from gnrecon.geometry.arrays import Float, Int
from gnrecon.geometry.point_cloud import Samples
from gnrecon.residuals.constraints import interface

CLEARLY = -0.5
"""Slope along a normal below which the field contradicts it; one that agrees has 1."""

UNITS = 500
ROUNDS = 3
OWN = 2
"""Tells this chance from the fit's own, which has the same seed, so that normals that stay leave the fit as it is."""


def reconciled(samples: Samples, rows: Int, options: FitOptions) -> tuple[Samples, float]:
    """Return the samples with the contradicted normals turned around, and their share in [0, 1].

    Parameters
    ----------
    samples : with normals of which some may be on the wrong side
    rows : of the samples that the field is fitted to
    options : of which the seed and the device are used

    Raises
    ------
    FitError
        When the linear system cannot be solved.
    """
    rng, before = np.random.default_rng([options.seed, OWN]), samples.normals
    for _ in range(ROUNDS):
        against = _slopes(samples, rows, options, rng) < CLEARLY
        samples = replace(samples, normals=np.where(against[:, None], -samples.normals, samples.normals))
        if not against.any():
            break
    return samples, float((samples.normals != before).any(axis=1).mean())


def _slopes(samples: Samples, rows: Int, options: FitOptions, rng: np.random.Generator) -> Float:
    """Return how steeply a field that is fitted without normals rises along them, of shape (N,)."""
    seen = replace(samples, points=samples.points[rows], normals=samples.normals[rows])
    scene, field = Scene.of(seen, options.device, rng), Siren((UNITS,))

    def terms(x: torch.Tensor, distance: torch.Tensor, most: int) -> list[Term]:
        return [Term("interface", interface, scene.points[:most], None, 1.0), distance_term(scene, x, distance)]

    theta = wide_start(field, scene, terms, rng, smooth_spectrum(min(LENGTHS), scene))
    sdf = NeuralSDF(field, theta, samples.frame, scene.box)
    slopes: Float = np.einsum("ij,ij->i", sdf.gradient(samples.frame.to_world(samples.points)), samples.normals)
    return slopes
