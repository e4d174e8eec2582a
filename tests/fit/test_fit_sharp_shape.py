"""Sharp shapes: samples that extend faces to their edges, and which scans are sharp."""

from __future__ import annotations

import re
from dataclasses import replace

import made_shapes
import numpy as np
import pytest

from gnrecon.fit import FitOptions, fit
from gnrecon.fit.shape_priors.bilateral_filter import BilateralFilter
from gnrecon.fit.shape_priors.edge_completion import EdgeCompletion
from gnrecon.fit.shape_priors.prior_parameters import ShapePriorParameters, SharpShapeParameters
from gnrecon.fit.shape_priors.sharp_shape import SharpShape, has_edges
from gnrecon.geometry.point_cloud import Frame, Samples
from gnrecon.geometry.signed_distance import Density
from gnrecon.ingest.orientation import oriented_normals

FRAME = Frame(np.array([10.0, -20.0, 30.0]), 2.0)
SIDE = 0.8
AVERAGING = BilateralFilter(SharpShapeParameters.averaging_width_radii, SharpShapeParameters.averaging_normal_scale)


def cube(count: int, noise: float = 0.0, tilt: float = 0.0, seed: int = 0) -> Samples:
    rng = np.random.default_rng(seed)
    x, normals = made_shapes.cube(count, SIDE, rng, noise)
    normals += tilt * rng.standard_normal((count, 3))
    return Samples(x, normals / np.linalg.norm(normals, axis=1, keepdims=True), FRAME)


def ball(count: int, noise: float = 0.0) -> Samples:
    return Samples(*made_shapes.sphere(count, 0, SIDE, noise), FRAME)


def rounded(count: int, radius: float) -> Samples:
    """Draw points of two planes at right angles, with a fillet between them, and the fillet's own points."""
    rng = np.random.default_rng(1)
    flat, bent = 1.0 - radius, np.pi / 2 * radius
    s, y = rng.uniform(-flat, flat + bent, count), rng.uniform(-0.7, 0.7, count)
    angle = np.clip(s / radius, 0.0, np.pi / 2)
    x = np.minimum(s, 0.0) + radius * np.sin(angle)
    z = radius * np.cos(angle) - np.maximum(s - bent, 0.0)
    normals = np.stack([np.sin(angle), np.zeros(count), np.cos(angle)], axis=1)
    return Samples(np.stack([x, y, z], axis=1), normals, FRAME)


def off_cube(x: np.ndarray) -> np.ndarray:
    outside = np.abs(x) - SIDE
    return np.abs(np.linalg.norm(np.maximum(outside, 0), axis=1) + np.minimum(outside.max(axis=1), 0))


def from_edges(x: np.ndarray) -> np.ndarray:
    """Return the distance along the faces from the cube's nearest edge."""
    return SIDE - np.sort(np.abs(x), axis=1)[:, 1]


def test_faces_of_a_cube_are_extended_to_its_edges_and_its_gaps_are_halved() -> None:
    scan = cube(600)
    found = SharpShape.of(scan)
    assert found is not None
    assert (found.averaging, found.snapped) == (None, None)
    x, normals = found.samples.points[600:], found.samples.normals[600:]
    assert (found.samples.points[:600] == scan.points).all()
    # One may extend a little farther where the other face has a gap, too.
    assert (off_cube(x) < 1e-9).mean() > 0.999
    assert off_cube(x).max() < 0.02
    # Each sample's normal is that of a face that it lies on.
    assert np.abs((x * normals).sum(axis=1) - SIDE).max() < 1e-9
    disk = Density(scan.points).radius
    places = cube(20_000, seed=3).points
    at_edges = places[from_edges(places) < 0.3 * disk]
    nearest = [Density(points).tree.query(at_edges)[0].mean() for points in (scan.points, found.samples.points)]
    assert nearest[1] < 0.75 * nearest[0]
    nearest = [Density(points).tree.query(places)[0].max() for points in (scan.points, found.samples.points)]
    assert nearest[1] < nearest[0]
    radius = Density(found.samples.points).radius
    assert found.hyperparameters.length == pytest.approx(SharpShapeParameters.exact_length_radii * radius)


def test_samples_between_points_of_a_cylinder_are_of_fourth_order() -> None:
    """Halving the angle between two points of a circle takes the error of the sample between them to a sixteenth."""

    def error(angle: float) -> float:
        turns, heights = angle * np.arange(6), np.array([0.0, 0.1])
        turn, height = (grid.ravel() for grid in np.meshgrid(turns, heights))
        normals = np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
        # The circle as large as needed for neighbours that are as far apart as the rows.
        radius = 0.1 / angle
        faces = EdgeCompletion(radius * normals + np.stack([0 * turn, 0 * turn, height], axis=1), normals)
        x, n, _ = faces.midpoints()
        radial = x[:, :2] / np.linalg.norm(x[:, :2], axis=1, keepdims=True)
        assert (radial * n[:, :2]).sum(axis=1) == pytest.approx(np.ones(len(x)), abs=1e-9)
        assert faces.roughness < 1e-12
        return float(np.abs(np.linalg.norm(x[:, :2], axis=1) - radius).max() / radius)

    assert error(0.1) / error(0.2) == pytest.approx(1 / 16, rel=0.05)


def test_noisy_faces_are_averaged_first() -> None:
    scan = cube(3000, noise=0.01, tilt=0.1)
    found = SharpShape.of(scan)
    assert found is not None
    assert found.averaging == AVERAGING
    assert off_cube(found.samples.points).mean() < 0.1 * off_cube(scan.points).mean()
    assert found.snapped is not None
    assert found.snapped.primitives == 6


def test_faces_are_found_where_normals_are_far_off() -> None:
    scan = cube(1500, tilt=0.3)
    averaged = EdgeCompletion(*AVERAGING.apply(scan.points, scan.normals))
    # Averages are rough as well, which says nothing of the faces.
    assert averaged.roughness > SharpShapeParameters.max_roughness_radii
    found = SharpShape.of(scan)
    assert found is not None
    assert found.snapped is not None
    assert found.snapped.on_primitive.mean() > 0.7
    radius = Density(scan.points).radius
    assert np.median(off_cube(found.snapped.points)) < 0.01 * radius
    assert SharpShape.of(ball(1500, 0.01)) is None


@pytest.mark.parametrize("samples", [ball(60), ball(1500), ball(1500, 0.01), rounded(3000, 0.3)])
def test_smooth_shapes_have_no_edges(samples: Samples) -> None:
    assert SharpShape.of(samples) is None


def test_outliers_are_no_edges() -> None:
    """Outliers of any direction lie on no face. But single points on a plate's sides show its edges."""
    rng = np.random.default_rng(2)
    smooth = ball(1500)
    normals = smooth.normals.copy()
    out = rng.choice(1500, 75, replace=False)
    aside = np.cross(normals[out], rng.standard_normal((75, 3)))
    normals[out] = 0.5 * normals[out] + aside / np.linalg.norm(aside, axis=1, keepdims=True)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = smooth.points + 0.1 * (normals - smooth.normals)
    assert has_edges(points, normals)
    assert SharpShape.of(replace(smooth, points=points, normals=normals)) is None
    plate = cube(500, seed=4)
    plate = replace(plate, points=plate.points * [1.0, 1.0, 0.02])
    sides = np.abs(plate.normals[:, 2]) < 0.5
    few = ~sides | (np.cumsum(sides) % 10 == 0)
    plate = replace(plate, points=plate.points[few], normals=plate.normals[few])
    assert SharpShape.of(plate) is not None


def test_where_two_faces_meet_in_a_fillet_nothing_is_added_beyond_it() -> None:
    """The planes on both sides of a fillet that has a few points of its own meet outside the shape."""
    samples = rounded(3000, 0.04)
    faces = EdgeCompletion(samples.points, samples.normals)
    *_, agreed = faces.edge_samples()
    assert agreed < SharpShapeParameters.min_agreement
    assert SharpShape.of(samples) is None
    # Without those points nothing contradicts.
    flat = np.abs(samples.normals).max(axis=1) > 1 - 1e-9
    *_, agreed = EdgeCompletion(samples.points[flat], samples.normals[flat]).edge_samples()
    assert agreed == 1.0


def test_faces_are_extended_by_the_normals_of_their_surfaces_where_normals_were_estimated() -> None:
    def exact(normals: np.ndarray) -> float:
        return float((np.abs(normals).max(axis=1) > np.cos(np.radians(5))).mean())

    off = []
    for seed in range(9):
        samples = cube(600, seed=seed)
        scanned = replace(samples, normals=oriented_normals(samples.points).normals, estimated=True)
        found = SharpShape.of(scanned)
        assert found is not None
        assert found.snapped is not None
        assert found.snapped.primitives == 6
        assert found.averaging is None
        assert exact(scanned.normals) < 0.9
        assert exact(found.samples.normals) > 0.98
        off.append(off_cube(found.samples.points))
    # A point on an edge whose normal is that of both faces places a few samples of some draws off the cube.
    assert np.median([np.quantile(one, 0.999) for one in off]) < 0.005
    assert np.median([one.max() for one in off]) < 0.03


def test_round_shapes_and_many_points_are_left_alone() -> None:
    samples = cube(600)
    assert SharpShape.of(replace(ball(600), estimated=True)) is None
    assert SharpShape.of(replace(samples, points=samples.points[:5], normals=samples.normals[:5])) is None
    few = ShapePriorParameters(sharp=SharpShapeParameters(max_points=599))
    assert SharpShape.of(samples, few) is None
    assert SharpShape.of(samples) is not None


def test_points_that_are_there_twice_do_no_harm() -> None:
    samples = cube(400)
    twice = replace(samples, **{n: np.concatenate([getattr(samples, n)] * 2) for n in ("points", "normals")})
    with np.errstate(all="raise"):
        found = SharpShape.of(twice)
    assert found is None or np.isfinite(found.samples.points).all()


@pytest.mark.parametrize("estimated", [False, True], ids=["given normals", "estimated normals"])
def test_the_fit_of_a_sparse_cube_is_sharper_and_says_so(monkeypatch: pytest.MonkeyPatch, estimated: bool) -> None:
    """Against the same fit without: the mean distance of its zero level from the cube's edges and faces."""
    scan, options = cube(500), FitOptions(quality="draft")
    if estimated:
        scan = replace(scan, normals=oriented_normals(scan.points).normals, estimated=True)
    exact = cube(3000, seed=5)
    # Beside the edges, where |f| of a signed distance is the distance.
    places = exact.points[from_edges(exact.points) < 0.1]

    def error() -> tuple[float, str]:
        sdf, solution = fit(scan, options)
        value, gradient = sdf.sdf_and_gradient(FRAME.to_world(places))
        slope = np.linalg.norm(gradient, axis=1).clip(0.3)
        return float(np.mean(np.abs(value) / slope)) / FRAME.scale, solution.status

    completed, status = error()
    assert "Extended faces to their sharp edges with" in status
    assert "degrees in normals" not in status
    assert ("points to 6 detected planes, cylinders and spheres" in status) == estimated
    monkeypatch.setattr(SharpShape, "of", classmethod(lambda *_: None))
    plain, status = error()
    assert "Extended" not in status
    assert completed < 0.7 * plain


def test_the_fit_of_a_noisy_cube_says_how_many_points_are_snapped_to_its_faces() -> None:
    _, solution = fit(cube(900, noise=0.01), FitOptions(quality="draft"))
    found = re.search(r"Snapped ([\d,]+) points to 6 detected planes, cylinders and spheres", solution.status)
    assert found is not None
    assert 870 < int(found[1].replace(",", "")) <= 900


def test_acute_edges_are_edges_and_the_sides_of_a_sheet_are_none() -> None:
    rng = np.random.default_rng(4)
    corners = 0.5 * np.array([[1.0, 1, 1], [-1, -1, 1], [-1, 1, -1], [1, -1, -1]])
    weights = rng.dirichlet(np.ones(3), 300)
    opposite = rng.integers(4, size=300)
    faces = np.array([[k for k in range(4) if k != corner] for corner in range(4)])
    points = np.einsum("nk,nkd->nd", weights, corners[faces[opposite]])
    scan = Samples(points, -corners[opposite] / np.linalg.norm(corners[0]), FRAME)
    found = SharpShape.of(scan)
    assert found is not None
    # On the faces' planes, and not beyond the edges.
    heights = found.samples.points @ -corners.T / np.linalg.norm(corners[0])
    assert heights.max() < heights[:300].max() + 1e-9
    disc = rng.uniform(-1, 1, (3000, 3)) * [0.8, 0.8, 0.0]
    disc = disc[np.hypot(disc[:, 0], disc[:, 1]) < 0.8]
    disc[:, 2] = 0.01 * rng.choice([-1.0, 1.0], len(disc))
    normals = np.sign(disc[:, 2:]) * [[0.0, 0.0, 1.0]] + 0.15 * rng.standard_normal(disc.shape)
    assert SharpShape.of(Samples(disc, normals / np.linalg.norm(normals, axis=1, keepdims=True), FRAME)) is None


def test_faces_that_meet_are_told_from_bends() -> None:
    def edges(samples: Samples) -> bool:
        return has_edges(*AVERAGING.apply(samples.points, samples.normals))

    assert edges(cube(1500))
    assert edges(cube(1500, 0.01))
    assert not edges(ball(1500, 0.01))
    # So few that neighbours' normals differ as if there were edges between them.
    assert not edges(ball(60))
    # The two sides of a thin sheet are no edge.
    rng = np.random.default_rng(2)
    side = rng.choice([-1.0, 1.0], 1000)
    x = np.stack([*rng.uniform(-1, 1, (2, 1000)), 0.002 * side], axis=1)
    assert not edges(Samples(x, np.stack([0 * side, 0 * side, side], axis=1), FRAME))
