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
from gnrecon.fit.field_model import NeuralSDF
from gnrecon.fit.fit_options import FitOptions
from gnrecon.fit.global_field import LENGTHS, smooth_spectrum
from gnrecon.fit.initialisation import wide_start
from gnrecon.fit.objective import Scene, Term, distance_term
from gnrecon.geometry.arrays import Float, Int, Mask
from gnrecon.geometry.point_cloud import Samples
from gnrecon.geometry.signed_distance import Density
from gnrecon.residuals.constraints import interface

CLEARLY = -0.5
"""Slope along a normal below which the field contradicts it; one that agrees has 1."""

UNITS = 500

ROUNDS = 3

OWN = 2
"""Tells this chance from the fit's own, which has the same seed, so that normals that stay leave the fit as it is."""


def flip_contradicted_normals(samples: Samples, rows: Int, options: FitOptions) -> tuple[Samples, float]:
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


NEIGHBOURS = 8

USUAL, TIMES = 0.95, 4.0
"""How far a point must be off: so many times the difference that this share of all points stays below."""

DISKS = 0.75
"""And so many radii of the disk that it stands for."""

LEAST, MOST = 0.002, 0.04
"""Shares of the points: fewer are chance, or edges, and do no harm; more tell of a field that does not fit."""

LEAST_POINTS = 100


# Points off the surface that a first field tells from the rest: outliers too near to it to be seen by distances alone.
#
# A smooth field leaves something over at every point, because it cannot follow edges and details; but what it leaves
# over varies slowly, so that neighbours agree on it. An outlier differs from its neighbours: by much more than points
# of the scan do, and by more than they are apart.


def find_outliers(value: Float, density: Density) -> Mask:
    """Return which points are off the surface, of shape (N,).

    Parameters
    ----------
    value : array of shape (N,)
        Of a smooth field at the points, unit coordinates.
    density : of the points, unit coordinates
    """
    if len(value) < LEAST_POINTS:
        return np.zeros(len(value), dtype=bool)
    # The first neighbour is the point itself.
    near = density.tree.query(density.points, NEIGHBOURS + 1)[1][:, 1:]
    off = np.abs(value - np.median(value[near], axis=1))
    found: Mask = off > np.maximum(TIMES * np.quantile(off, USUAL), DISKS * density.disks)
    return found if LEAST <= found.mean() <= MOST else np.zeros_like(found)
