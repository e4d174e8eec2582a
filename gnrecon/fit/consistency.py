"""Checks of the data against a first field: normals on the wrong side, and outliers near the surface.

*Normals* (`flip_contradicted_normals`). A field that is zero at the points and follows the coarse signed distance in
free space is fitted without normals. A small patch of wrong normals hardly changes the winding number, which gives that
distance its sign, so that the field's gradient points against them. In a thin wall that the field does not resolve, its
gradient is short, and the normals stay. So do those of a patch that continues its surroundings smoothly: at the border
of an open sheet the winding number has no sign. The fit is repeated with the new normals. Source: Hou et al.,
*Iterative Poisson Surface Reconstruction for Unoriented Points*, ACM TOG 2022, with this fit instead of Poisson's.

*Outliers*: `find_outliers`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from gnrecon.field.networks import Siren
from gnrecon.fit.field_model import NeuralSDF
from gnrecon.fit.fit_options import FitOptions
from gnrecon.fit.initialisation import wide_start
from gnrecon.fit.linear_field import smooth_spectrum
from gnrecon.fit.objective import ObjectiveTerm, Scene
from gnrecon.fit.parameters import LinearFieldParameters, OutlierParameters
from gnrecon.geometry.arrays import Float, Int, Mask
from gnrecon.geometry.point_cloud import Samples
from gnrecon.geometry.signed_distance import Density
from gnrecon.residuals.constraints import interface


def flip_contradicted_normals(
    samples: Samples, rows: Int, options: FitOptions, *, most_slope: float = -0.5, rounds: int = 3, units: int = 500
) -> tuple[Samples, float]:
    """Return the samples with the contradicted normals turned around, and their share in [0, 1].

    Parameters
    ----------
    samples : with normals of which some may be on the wrong side
    rows : of the samples that the field is fitted to
    options : of which the seed and the device are used
    most_slope : slope of the field along a normal below which the normal is turned around; one that agrees has 1
    rounds : most fits, each with the normals of the last one; few scans need a second
    units : sine features of these fits

    Raises
    ------
    FitError
        When the linear system cannot be solved.
    """
    # A stream of its own: where no normal is turned around, the fit draws the same numbers as without this check.
    rng, before = np.random.default_rng([options.seed, 2]), samples.normals
    for _ in range(rounds):
        against = without_smooth_patches(samples, _slopes(samples, rows, options, rng, units) < most_slope)
        samples = replace(samples, normals=np.where(against[:, None], -samples.normals, samples.normals))
        if not against.any():
            break
    return samples, float((samples.normals != before).any(axis=1).mean())


def without_smooth_patches(samples: Samples, against: Mask, *, neighbours: int = 8, least_cosine: float = 0.9) -> Mask:
    """Return a mask of shape (N,) without the patches whose normals agree with those around them.

    Parameters
    ----------
    samples : with normals
    against : mask of shape (N,), normals that a field contradicts; those that are neighbours make a patch
    neighbours : of a point
    least_cosine : of the angle, of 25 degrees, up to which normals are of one smooth surface, or of its two sides
    """
    if not against.any():
        return against
    near = cKDTree(samples.points).query(samples.points, min(neighbours + 1, len(samples)))[1][:, 1:]
    start, end = np.repeat(np.arange(len(near)), near.shape[1]), near.ravel()
    inside, rim = against[start] & against[end], against[start] != against[end]
    links = coo_array((np.ones(inside.sum(), np.int8), (start[inside], end[inside])), shape=(len(near), len(near)))
    patches = connected_components(links, directed=False)[1]
    cosines = np.einsum("ij,ij->i", samples.normals[start[rim]], samples.normals[end[rim]])
    votes = np.where(np.abs(cosines) < least_cosine, 0.0, np.sign(cosines))
    of_patch = patches[np.where(against[start[rim]], start[rim], end[rim])]
    kept: Mask = against & (np.bincount(of_patch, votes, len(near))[patches] <= 0)
    return kept


def _slopes(samples: Samples, rows: Int, options: FitOptions, rng: np.random.Generator, units: int) -> Float:
    """Return how steeply a field that is fitted without normals rises along them, of shape (N,)."""
    seen = samples.select(rows)
    scene, field = Scene.of(seen, options.device, rng), Siren((units,))

    data = [ObjectiveTerm("interface", interface, scene.points)]
    theta = wide_start(field, scene, data, rng, smooth_spectrum(min(LinearFieldParameters.length_scales_radii), scene))
    sdf = NeuralSDF(field, theta, samples.frame, scene.box)
    slopes: Float = np.einsum("ij,ij->i", sdf.gradient(samples.frame.to_world(samples.points)), samples.normals)
    return slopes


# Outliers near the surface, which distances alone do not show.
#
# A smooth field has residuals at every point, because it cannot follow edges and details. But they vary slowly, so that
# neighbours agree. An outlier differs from its neighbours: by much more than other points do, and by more than the
# spacing of the points.


def find_outliers(value: Float, density: Density, *, parameters: OutlierParameters = OutlierParameters()) -> Mask:
    """Return which points are outliers, a mask of shape (N,).

    Parameters
    ----------
    value : array of shape (N,)
        Values of a smooth field at the points, unit coordinates.
    density : of the points, unit coordinates
    parameters : thresholds
    """
    if len(value) < parameters.least_points:
        return np.zeros(len(value), dtype=bool)
    # The first neighbour is the point itself.
    near = density.tree.query(density.points, parameters.neighbours + 1)[1][:, 1:]
    off = np.abs(value - np.median(value[near], axis=1))
    usual = parameters.quantile_factor * np.quantile(off, parameters.quantile)
    found: Mask = off > np.maximum(usual, parameters.least_distance_disk_radii * density.disks)
    return found if parameters.least_share <= found.mean() <= parameters.most_share else np.zeros_like(found)
