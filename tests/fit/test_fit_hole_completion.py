"""Planes and cylinders found among points, minimal cuts, and faces extended across holes."""

from __future__ import annotations

from dataclasses import replace

import made_shapes
import numpy as np
import pytest
from made_shapes import bored_plate
from scipy import ndimage

from gnrecon.fit import FitOptions, fit, two_level
from gnrecon.fit.shape_priors.bores import in_bore_opening
from gnrecon.fit.shape_priors.hole_completion import HoleCompletion, are_in_a_hole, complete_holes, encloses
from gnrecon.fit.shape_priors.min_cut import minimal_inside
from gnrecon.fit.shape_priors.primitive_detection import detect_primitives, planar_share
from gnrecon.fit.shape_priors.primitives import Cylinder, Plane, Sphere, is_inlier, project
from gnrecon.fit.shape_priors.prior_parameters import DetectionParameters
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.point_cloud import Frame, Samples

SIDE = 0.6
HEIGHT, BORE = 0.25, 0.4


def cube(count: int, seed: int = 0) -> tuple[Float, Float]:
    return made_shapes.cube(count, SIDE, seed)


def ball(count: int) -> tuple[Float, Float]:
    return made_shapes.sphere(count, 0, SIDE)


def bored(count: int, seed: int = 0) -> tuple[Float, Float]:
    return bored_plate(count, SIDE, HEIGHT, BORE, seed)


def off_cube(x: Float) -> Float:
    return made_shapes.off_cube(x, SIDE)


def without(points: Float, normals: Float, middle: list[float], reach: float) -> tuple[Float, Float]:
    kept = np.linalg.norm(points - middle, axis=1) > reach
    return points[kept], normals[kept]


def noisy(points: Float, normals: Float, noise: float, tilt: float) -> tuple[Float, Float]:
    rng = np.random.default_rng(1)
    turned = normals + tilt * rng.standard_normal(normals.shape)
    return points + noise * rng.standard_normal(points.shape), turned / np.linalg.norm(turned, axis=1, keepdims=True)


def found(points: Float, normals: Float, radius: float, off: float, sparse: bool = False) -> list[Plane | Cylinder]:
    everything, rng = np.ones(len(points), dtype=bool), np.random.default_rng(0)
    detected = detect_primitives(points, normals, everything, radius, off, rng, DetectionParameters(sparse=sparse))
    return [one.surface for one in detected]


def test_a_plane_and_a_bore_are_found_among_points_that_lie_on_neither() -> None:
    rng = np.random.default_rng(2)
    points, normals = noisy(*bored(4000), 0.002, 0.05)
    strays = rng.uniform(-SIDE, SIDE, (200, 3)), rng.standard_normal((200, 3))
    strays[1][:] /= np.linalg.norm(strays[1], axis=1, keepdims=True)
    there = found(np.concatenate([points, strays[0]]), np.concatenate([normals, strays[1]]), 0.02, 0.008)
    heights = sorted(
        round(float(one.center[2]), 2) for one in there if isinstance(one, Plane) and abs(one.direction[2]) > 0.99
    )
    assert heights == [-HEIGHT, HEIGHT]
    bores = [one for one in there if isinstance(one, Cylinder)]
    assert len(bores) == 1
    assert bores[0].side == -1.0
    assert bores[0].radius == pytest.approx(BORE, abs=2e-3)
    assert abs(bores[0].axis[2]) > 0.9999


def test_a_face_that_was_seen_from_the_side_is_found_though_its_points_are_few() -> None:
    points, normals = noisy(*cube(6000), 0.002, 0.05)
    rng = np.random.default_rng(3)
    kept = (points[:, 2] < SIDE - 0.02) | (rng.random(len(points)) < 0.06)
    points, normals = points[kept], normals[kept]
    sparse = points[:, 2] > SIDE - 0.02
    assert 40 < sparse.sum() < 90
    upper = [
        one
        for one in found(points, normals, 0.02, 0.008, sparse=True)
        if isinstance(one, Plane) and one.direction[2] > 0.99
    ]
    assert len(upper) == 1
    assert upper[0].center[2] == pytest.approx(SIDE, abs=2e-3)


def test_the_share_on_planes_separates_machine_parts_from_free_form_shapes() -> None:
    def share(points: Float, normals: Float) -> float:
        return planar_share(points, normals, 0.022, 0.007, np.random.default_rng(0))

    assert share(*ball(3000)) == 0.0
    assert share(*cube(3000)) > 0.99
    points, normals = bored(3000)
    on_planes = np.hypot(points[:, 0], points[:, 1]) > BORE + 1e-9
    # Planes take strips off the bore, too.
    assert on_planes.mean() - 0.02 < share(points, normals) < 0.95


def test_a_cylinder_of_two_sides() -> None:
    for side in (-1.0, 1.0):
        one = Cylinder(np.array([0.1, 0.0, 5.0]), np.array([0.0, 0.0, 1.0]), 2.0, side)
        x = np.array([[3.1, 0.0, -7.0], [0.1, 1.0, 2.0]])
        np.testing.assert_allclose(one.signed_distance(x), side * np.array([1.0, -1.0]))
        np.testing.assert_allclose(one.normal(x), side * np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]))
        on = np.array([[2.2, 0.0, 0.0]])
        assert is_inlier(one, on, one.normal(on), 0.2).all()
        assert not is_inlier(one, on, -one.normal(on), 0.2).any()
        assert not is_inlier(one, on, one.normal(on), 0.05).any()


def corner(size: int, hidden: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the cells of a box's corner, those known except a cube around it, and signed distances of its faces."""
    half = size // 2 - 0.5
    at = np.stack(np.meshgrid(*[np.arange(size) - half] * 3, indexing="ij"), axis=-1)
    inside = (at < 0).all(axis=-1)
    known = np.where(inside, 1, -1)
    known[(np.abs(at) < hidden).all(axis=-1)] = 0
    return inside, known, at


def test_a_minimal_cut_runs_along_faces_to_a_corner_and_without_them_takes_the_short_way() -> None:
    inside, known, signed = corner(16, 5)
    believed = np.ones(signed.shape, dtype=bool)
    np.testing.assert_array_equal(minimal_inside(known, signed, believed), inside)
    cut = minimal_inside(known, signed, ~believed)
    assert 0 < (cut != inside).sum() < (known == 0).sum()
    assert not (cut & ~inside).any()
    assert not cut[7, 7, 7]


def test_cells_enclosed_by_a_cut_are_counted() -> None:
    sides = np.zeros((12, 12, 12), dtype=bool)
    scanned = np.zeros_like(sides)
    scanned[5:8, 5:8, 5:8] = True
    assert not encloses(sides, scanned)
    sides[3:10, 3:10, 3:10] = True
    sides[5:8, 5:8, 5:8] = False
    assert encloses(sides, scanned)
    sides[5:, 6, 6] = False
    assert not encloses(sides, scanned)


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("middle", [[SIDE, SIDE, SIDE], [SIDE, SIDE, 0.1], [SIDE, 0.1, 0.0]])
def test_faces_go_on_across_a_hole_to_edge_and_corner(middle: list[float], seed: int) -> None:
    whole = cube(2500, seed)
    points, normals = without(*whole, middle, 0.35)
    across = complete_holes(points, normals)
    assert across.holes == 1
    off = off_cube(across.points)
    assert (off < 1e-9).mean() > 0.97
    # They lie in the hole, and fill it.
    hidden = whole[0][np.linalg.norm(whole[0] - middle, axis=1) < 0.3]
    apart = np.linalg.norm(hidden[:, None] - across.points, axis=2).min(axis=1)
    assert np.quantile(apart, 0.95) < 0.1
    assert np.linalg.norm(across.points - middle, axis=1).max() < 0.45


def test_the_samples_are_as_dense_as_the_scan() -> None:
    whole = cube(4000)
    across = complete_holes(*without(*whole, [SIDE, 0.0, 0.0], 0.4))
    missing = 4000 - len(without(*whole, [SIDE, 0.0, 0.0], 0.3)[0])
    near = np.linalg.norm(across.points - [SIDE, 0.0, 0.0], axis=1) < 0.3
    assert 0.5 < near.sum() / missing < 1.5


def test_a_bore_of_which_a_part_was_seen_goes_on() -> None:
    points, normals = noisy(*bored(9000), 0.002, 0.05)
    on_wall = np.abs(np.hypot(points[:, 0], points[:, 1]) - BORE) < 0.01
    hidden = on_wall & (points[:, 0] > -0.15) & (np.abs(points[:, 2]) < 0.18)
    across = complete_holes(points[~hidden], normals[~hidden])
    assert across.holes
    wall = np.abs(np.hypot(across.points[:, 0], across.points[:, 1]) - BORE) < 0.01
    faces = np.abs(np.abs(across.points) - [SIDE, SIDE, HEIGHT]).min(axis=1) < 0.01
    assert (wall | faces).mean() > 0.98
    # They fill what was hidden of the wall, and leave its openings free.
    apart = np.linalg.norm(points[hidden][:, None] - across.points[wall], axis=2).min(axis=1)
    assert np.quantile(apart, 0.95) < 0.06
    assert not (np.hypot(across.points[:, 0], across.points[:, 1]) < BORE - 0.02).any()


def across_opening(height: float) -> tuple[Float, Float]:
    """Samples of a disk that shuts the bore of the plate."""
    angle, away = np.meshgrid(np.linspace(0, 2 * np.pi, 12, endpoint=False), [0.05, 0.15, 0.25, 0.35])
    x = np.stack([away * np.cos(angle), away * np.sin(angle), np.full(angle.shape, height)], axis=-1).reshape(-1, 3)
    return x, np.broadcast_to([0.0, 0.0, np.sign(height)], x.shape)


def test_the_opening_of_a_bore_whose_wall_was_scanned_is_recognised() -> None:
    points, normals = bored(6000)
    scanned = (np.hypot(points[:, 0], points[:, 1]) > BORE + 1e-6) | (points[:, 2] > 0.05)
    points, normals = points[scanned], normals[scanned]
    for turn in (np.eye(3), np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])):
        shut, sample_normals = across_opening(HEIGHT)
        assert in_bore_opening(shut @ turn, sample_normals @ turn, points @ turn, normals @ turn).all()
    # A wall that was scanned at one end only does not show the other opening.
    end = (np.hypot(points[:, 0], points[:, 1]) > BORE + 1e-6) | (points[:, 2] > HEIGHT - 0.03)
    assert in_bore_opening(*across_opening(HEIGHT), points[end], normals[end]).all()
    assert not in_bore_opening(*across_opening(-HEIGHT), points[end], normals[end]).any()
    assert in_bore_opening(np.zeros((0, 3)), np.zeros((0, 3)), points, normals).shape == (0,)


def test_the_floor_of_a_blind_bore_and_a_face_without_one_are_no_openings() -> None:
    points, normals = bored(6000)
    inner = np.hypot(points[:, 0], points[:, 1]) < BORE + 1e-6
    floor, up = across_opening(0.1)
    above = ~inner | (points[:, 2] > 0.1)
    assert not in_bore_opening(floor, up, points[above], normals[above]).any()
    # A face with a hole that was not scanned has faces behind it, which look away from it.
    x, out = cube(6000)
    left, sample_normals = without(x, out, [0.0, 0.0, SIDE], 0.4)
    patch, up = across_opening(SIDE)
    assert not in_bore_opening(patch, up, left, sample_normals).any()


def test_the_side_of_a_can_goes_on() -> None:
    rng = np.random.default_rng(0)
    angle, height = rng.uniform(0, 2 * np.pi, 1500), rng.uniform(-0.7, 0.7, 1500)
    side = np.stack([np.cos(angle), np.sin(angle), np.zeros(1500)], axis=1)
    lid = rng.uniform(-0.4, 0.4, (900, 3))
    lid = lid[np.hypot(lid[:, 0], lid[:, 1]) < 0.4]
    up = np.where(rng.random((len(lid), 1)) < 0.5, -1.0, 1.0) * [0.0, 0.0, 1.0]
    points = np.concatenate([0.4 * side + height[:, None] * [0, 0, 1], lid * [1, 1, 0] + 0.7 * up])
    across = complete_holes(*without(points, np.concatenate([side, up]), [0.4, 0.0, 0.0], 0.3))
    assert across.holes == 1
    assert len(across) > 20
    np.testing.assert_allclose(np.hypot(across.points[:, 0], across.points[:, 1]), 0.4, atol=1e-9)
    assert np.abs(across.points[:, 2]).max() < 0.4


@pytest.mark.parametrize("surface", [Cylinder(np.zeros(3), np.eye(3)[2], 0.5, -1.0), Sphere(np.zeros(3), 0.5, 1.0)])
def test_a_round_primitive_is_fitted_where_no_step_comes_nearer(surface: Cylinder | Sphere) -> None:
    rng, size = np.random.default_rng(3), 0.05

    def cost(one: Cylinder | Sphere) -> float:
        heights, turns = one.signed_distance(points) / size, 0.3 * (one.normal(points) - normals)
        return float(np.square(heights).sum() + np.square(turns).sum())

    def moved(one: Cylinder | Sphere, by: float) -> Cylinder | Sphere:
        center, radius = one.center + by * rng.standard_normal(3), one.radius + by * rng.standard_normal()
        if isinstance(one, Sphere):
            return replace(one, center=center, radius=radius)
        axis = one.axis + by * rng.standard_normal(3)
        return replace(one, center=center, radius=radius, axis=axis / np.linalg.norm(axis))

    points = project(surface, rng.uniform(-0.6, 0.6, (60, 3)))
    points, normals = noisy(points, surface.normal(points), 0.01, 0.1)
    found = moved(surface, 0.05).refitted(points, normals, size, 0.3)
    assert found.side == surface.side
    assert cost(found) < cost(surface)
    assert min(cost(moved(found, by)) for by in (1e-4, 1e-3, 1e-2) for _ in range(50)) > cost(found)


def test_a_place_is_in_a_hole_until_that_is_closed() -> None:
    points, normals = without(*cube(2500), [SIDE, SIDE, 0.0], 0.35)
    places = np.array([[SIDE, SIDE, 0.0], [0.0, 0.0, 0.0], [0.0, SIDE + 0.3, 0.0], [0.0, SIDE + 0.02, 0.0]])
    assert [are_in_a_hole(place[None], points, normals) for place in places] == [True, False, False, False]
    assert are_in_a_hole(places, points, normals)
    assert not are_in_a_hole(places, points[:1], normals[:1])
    assert not are_in_a_hole(places, *complete_holes(points, normals).appended_to(points, normals))


@pytest.mark.parametrize("hides", [False, True])
def test_holes_are_completed_again_where_an_outlier_was_in_one(monkeypatch: pytest.MonkeyPatch, hides: bool) -> None:
    points, normals = without(*cube(1500), [SIDE, SIDE, SIDE], 0.4)
    shift = 0.8 if hides else 1.2  # in the missing corner, or outside
    outliers = SIDE * np.array([[shift, shift, shift], [shift, shift, 1.0], [shift, 1.0, shift], [1.0, shift, shift]])
    points, normals = np.concatenate([points, outliers]), np.concatenate([normals, -normals[:4]])
    searched: list[int] = []

    def counted(points: Float, *arguments: object) -> HoleCompletion:
        searched.append(len(points))
        return complete_holes(points, *arguments)

    monkeypatch.setattr(two_level, "complete_holes", counted)
    monkeypatch.setattr(two_level.SharpShape, "of", lambda *_: None)
    monkeypatch.setattr(two_level, "find_outliers", lambda value, *_, **__: np.arange(len(value)) >= len(value) - 4)
    scan = Samples(points, normals, Frame(np.zeros(3), 1.0))
    sdf, solution = fit(scan, FitOptions(quality="draft"))
    assert searched == ([len(points), len(points) - 4] if hides else [len(points)])
    assert sdf.support is not None
    support = sdf.support.astype(np.float64)
    corner = support[np.linalg.norm(support - SIDE, axis=1) < 0.35]
    assert (off_cube(corner) < 1e-6).sum() > 30
    assert "4 outliers" in solution.status


@pytest.mark.parametrize("scan", [cube(2500), ball(2000), without(*ball(2000), [SIDE, 0.0, 0.0], 0.3), cube(40)])
def test_whole_shapes_and_round_ones_have_nothing_to_go_on(scan: tuple[Float, Float]) -> None:
    across = complete_holes(*scan)
    assert len(across) == across.holes == 0


def test_holes_are_not_looked_for_in_free_form_shapes(monkeypatch: pytest.MonkeyPatch) -> None:
    searches: list[int] = []
    monkeypatch.setattr(ndimage, "label", lambda cells, **_: searches.append(1) or (0 * cells, 0))
    points, normals = made_shapes.sphere(2000, 0, SIDE)
    some = points[:, 2] < 0.4 * SIDE
    assert not len(complete_holes(points[some], normals[some]))
    assert not searches
    complete_holes(*without(*cube(2000), [SIDE, SIDE, SIDE], 0.3))
    assert searches


def test_a_round_shape_with_one_flat_side_is_not_extended() -> None:
    """Across a hole in its flat side a plane would extend; but nothing else of it is flat."""
    points, normals = ball(4000)
    below = points[:, 2] < -0.8 * SIDE
    points[below, 2], normals[below] = -0.8 * SIDE, [0.0, 0.0, -1.0]
    assert 0.05 < below.mean() < 0.15
    assert not len(complete_holes(*without(points, normals, [0.0, 0.0, -0.8 * SIDE], 0.2)))


def test_points_that_crowd_in_a_corner_make_no_lattice_without_end() -> None:
    points, normals = cube(3000)
    crowd = np.random.default_rng(3).uniform(0.0, 1e-4, (4000, 3)) * [1, 1, 0] + [0.1, 0.1, SIDE]
    up = np.tile([0.0, 0.0, 1.0], (len(crowd), 1))
    assert len(complete_holes(np.concatenate([points, crowd]), np.concatenate([normals, up]))) < 3000


def test_noise_is_no_hole_and_an_open_side_no_place_for_samples() -> None:
    assert not len(complete_holes(*noisy(*cube(2500), 0.01, 0.2)))
    points, normals = cube(2500)
    scanned = points[:, 2] > -0.5 * SIDE
    across = complete_holes(points[scanned], normals[scanned])
    assert across.points[:, 2].min(initial=0.0) > -1.05 * SIDE


FRAME = Frame(np.array([10.0, -20.0, 30.0]), 2.0)


@pytest.mark.parametrize(("tilt", "most"), [(0.0, 0.01), (0.06, 0.02)])
def test_a_fit_closes_a_corner_that_nobody_saw(tilt: float, most: float) -> None:
    middle = [SIDE, SIDE, SIDE]
    whole = cube(1500)
    points, normals = noisy(*without(*whole, middle, 0.35), 0.002 if tilt else 0.0, tilt)
    hidden = whole[0][np.linalg.norm(whole[0] - middle, axis=1) < 0.3]
    sdf, solution = fit(Samples(points, normals, FRAME), FitOptions(quality="draft"))
    assert "Extended planes and cylinders across 1 hole with" in solution.status
    assert np.abs(sdf.sdf(FRAME.to_world(hidden))).mean() < most * FRAME.scale


def test_a_smooth_scan_is_closed_as_before() -> None:
    scan = without(*ball(800), [SIDE, 0.0, 0.0], 0.3)
    _, solution = fit(Samples(*scan, FRAME), FitOptions(quality="draft"))
    assert "across" not in solution.status
