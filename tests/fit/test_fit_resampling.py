"""Samples of planes and cylinders: on them, up to where they meet, and no farther."""

from __future__ import annotations

import made_shapes
import numpy as np
import pytest
from made_shapes import bored_plate
from scipy.spatial import cKDTree

from gnrecon.fit import FitOptions, fit
from gnrecon.fit.shape_priors.prior_parameters import ResamplingParameters
from gnrecon.fit.shape_priors.resampling import resample_primitives
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.point_cloud import Frame, Samples
from gnrecon.geometry.signed_distance import Density

SIDE, HEIGHT, BORE = 0.7, 0.2, 0.25
FRAME = Frame(np.array([10.0, -20.0, 30.0]), 2.0)

Oriented = tuple[Float, Float]


def cube(count: int, seed: int = 0) -> Oriented:
    return made_shapes.cube(count, SIDE, seed)


def off_cube(x: Float) -> Float:
    return made_shapes.off_cube(x, SIDE)


def off_plate(x: Float) -> Float:
    """Distance to the surface of the bored plate, but for where two of its faces are as near."""
    slab = np.abs(x) - [SIDE, SIDE, HEIGHT]
    bore = BORE - np.hypot(x[:, 0], x[:, 1])
    return np.asarray(np.abs(np.maximum(slab.max(axis=1), bore)))


def gaps(points: Float, places: Float) -> Float:
    return np.asarray(cKDTree(points).query(places)[0])


def ball(count: int) -> Oriented:
    return made_shapes.sphere(count, 0, SIDE)


def torus(count: int) -> Oriented:
    return made_shapes.torus(count, 1, 0.6, 0.25)


@pytest.mark.parametrize(("count", "seed"), [(60, 0), (60, 1), (400, 2)])
def test_a_cube_is_covered_up_to_its_edges_and_corners(count: int, seed: int) -> None:
    points, normals = cube(count, seed)
    samples, sample_normals = resample_primitives(points, normals)
    assert 3 * count < len(samples) <= 1.2 * ResamplingParameters.max_samples_per_point * count
    assert off_cube(samples).max() < 1e-9
    assert np.abs((samples * sample_normals).sum(axis=1) - SIDE).max() < 1e-9
    places = cube(20_000, 9)[0]
    before, after = gaps(points, places), gaps(np.concatenate([points, samples]), places)
    assert after.mean() < 0.45 * before.mean()
    at_edges = np.sort(np.abs(places), axis=1)[:, 1] > SIDE - 0.03
    assert after[at_edges].mean() < 0.5 * before[at_edges].mean()


def test_a_bore_has_samples_on_its_wall_and_none_in_its_openings() -> None:
    points, normals = bored_plate(900, SIDE, HEIGHT, BORE)
    samples, sample_normals = resample_primitives(points, normals)
    assert len(samples) > 3000
    assert np.quantile(off_plate(samples), 0.998) < 1e-6
    assert off_plate(samples).max() < 0.5 * Density(points).radius
    wall = np.abs(np.hypot(samples[:, 0], samples[:, 1]) - BORE) < 1e-6
    assert wall.sum() > 200
    inward = -samples[wall, :2] / BORE
    assert np.abs(sample_normals[wall, :2] - inward).max() < 1e-5


def test_a_thin_plate_does_not_grow_beyond_a_rim_of_which_little_was_seen() -> None:
    rng = np.random.default_rng(4)
    half = np.array([0.8, 0.6, 0.016])
    areas = np.array([half[1] * half[2], half[0] * half[2], half[0] * half[1]])
    axis = rng.choice(3, 600, p=areas / areas.sum())
    points, normals, rows = rng.uniform(-half, half, (600, 3)), np.zeros((600, 3)), np.arange(600)
    normals[rows, axis] = rng.choice([-1.0, 1.0], 600)
    points[rows, axis] = normals[rows, axis] * half[axis]
    assert (axis < 2).sum() < 40
    samples, _ = resample_primitives(points, normals)
    assert len(samples) > 3000
    beyond = (np.abs(samples) - half).max(axis=1)
    assert (beyond > 1e-6).mean() < 0.02
    assert beyond.max() < 2.5 * Density(points).radius


def test_an_open_side_stays_open() -> None:
    points, normals = cube(900)
    scanned = points[:, 2] > -SIDE + 1e-9
    samples, _ = resample_primitives(points[scanned], normals[scanned])
    radius = Density(points[scanned]).radius
    assert samples[:, 2].min() > -SIDE - 3 * radius
    assert (np.abs(samples[samples[:, 2] < -SIDE + 0.01]).max(axis=1) > SIDE - 1e-6).all()


@pytest.mark.parametrize("scan", [ball(500), torus(500), cube(20_000)])
def test_round_shapes_and_dense_scans_get_none(scan: Oriented) -> None:
    samples, normals = resample_primitives(*scan)
    assert samples.shape == normals.shape == (0, 3)


def test_points_that_crowd_ask_for_no_more_than_others() -> None:
    points, normals = cube(900)
    crowd, sample_normals = cube(40_000, 3)
    near = np.linalg.norm(crowd - SIDE, axis=1) < 0.15
    joined = np.concatenate([points, crowd[near]]), np.concatenate([normals, sample_normals[near]])
    assert near.sum() > 100
    samples, _ = resample_primitives(*joined)
    assert 2000 < len(samples) < 12_000
    # One may extend a little farther where the other face has a gap, too.
    assert (off_cube(samples) < 1e-9).mean() > 0.999
    assert off_cube(samples).max() < 0.01


def test_the_fit_of_few_points_of_a_cube_has_its_edges() -> None:
    """Without these samples the mean is ten times as much."""
    sdf, _ = fit(Samples(*cube(80), FRAME), FitOptions(quality="draft"))
    places = cube(4000, 5)[0]
    assert np.abs(sdf.sdf(FRAME.to_world(places))).mean() / FRAME.scale < 0.01
