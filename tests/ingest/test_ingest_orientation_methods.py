"""Estimated normals agree with the analytic ones, in direction and in sign."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from analytic_clouds import thin_shell, torus
from made_shapes import sphere

from gnrecon.ingest import flip_if_inward, oriented_normals
from gnrecon.ingest.normal_agreement import agreement_of
from gnrecon.ingest.orientation_methods import (
    consistent_normals,
    gauss_normals,
    outwardness,
    winding_at_points,
    winding_disorder,
)
from gnrecon.ingest.orientation_methods import winding_agreement as confirmed
from gnrecon.runtime.errors import InputError

Shape = Callable[[int, np.random.Generator], tuple[np.ndarray, np.ndarray]]
UTM = np.array([431234.123456789, 5412345.987654321, 312.1])


def agreement(normals: np.ndarray, truth: np.ndarray) -> float:
    return float((np.einsum("ij,ij->i", normals, truth) > 0).mean())


@pytest.mark.parametrize("shape", [sphere, torus])
@pytest.mark.parametrize("count", [100, 500, 5000])
@pytest.mark.parametrize("offset", [0.0, UTM])
def test_normals_are_outward(shape: Shape, count: int, offset: float) -> None:
    points, truth = shape(count, np.random.default_rng(count))
    found = oriented_normals(points + offset)
    normals, how = found.normals, found.how
    assert found.confidence is not None
    assert found.confidence > 0.8
    assert agreement(normals, truth) >= 0.99
    assert np.einsum("ij,ij->i", normals, truth).mean() > (0.9 if count < 500 else 0.97)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1)
    assert how == "estimated"


def test_thin_walls_of_a_sparse_cloud_are_told_apart() -> None:
    points, truth = thin_shell(600, np.random.default_rng(0))
    assert agreement(oriented_normals(points).normals, truth) >= 0.99


def test_several_bodies_all_look_outward() -> None:
    rng = np.random.default_rng(0)
    (a, na), (b, nb) = torus(2000, rng), sphere(1500, rng)
    normals = oriented_normals(np.vstack([a, 0.5 * b + [0, 0, 2.5]])).normals
    assert agreement(normals, np.vstack([na, nb])) >= 0.99


def test_an_open_scan_looks_at_its_scanner() -> None:
    points, truth = sphere(6000, np.random.default_rng(0))
    seen = points[:, 2] > 0.5
    found = oriented_normals(points[seen])
    assert agreement(found.normals, truth[seen]) >= 0.99
    assert found.how == "estimated, orientation uncertain"


def test_a_terrain_looks_upward() -> None:
    x, y = np.random.default_rng(0).uniform(-1, 1, (2, 4000))
    found = oriented_normals(np.column_stack([x, y, 0.1 * np.sin(4 * x) * np.cos(3 * y)]))
    assert (found.normals[:, 2] > 0).mean() >= 0.99
    assert found.how == "estimated, upward, as of an open surface"


def test_the_smallest_clouds_are_served() -> None:
    points, truth = sphere(10, np.random.default_rng(0))
    assert agreement(oriented_normals(points).normals, truth) >= 0.8
    with pytest.raises(InputError, match="from 3 points that span no volume"):
        oriented_normals(points[:3])


def test_estimates_are_reproducible() -> None:
    points = torus(1500, np.random.default_rng(0))[0]
    np.testing.assert_array_equal(oriented_normals(points).normals, oriented_normals(points).normals)


@pytest.mark.parametrize("shape", [sphere, torus])
def test_gauss_formula_gives_directions_and_signs(shape: Shape) -> None:
    points, truth = shape(800, np.random.default_rng(0))
    cosines = np.einsum("ij,ij->i", gauss_normals(points), truth)
    assert (cosines > 0).mean() >= 0.995
    assert cosines.mean() > 0.85


@pytest.mark.parametrize("shape", [sphere, torus, thin_shell])
def test_consistency_with_the_winding_number_betters_the_gauss_formula(shape: Shape) -> None:
    points, truth = shape(700, np.random.default_rng(1))
    first = gauss_normals(points)
    refined = consistent_normals(points, first)
    cosines = [np.einsum("ij,ij->i", normals, truth) for normals in (first, refined)]
    assert (cosines[1] > 0).mean() >= 0.995
    assert np.mean(1 - cosines[1]) < 0.75 * np.mean(1 - cosines[0])
    np.testing.assert_allclose(np.linalg.norm(refined, axis=1), 1)


def test_most_wrong_sides_of_a_first_guess_are_found_out() -> None:
    points, truth = torus(700, np.random.default_rng(2))
    patch = points[:, 0] > 0.8
    assert patch.sum() > 50
    refined = consistent_normals(points, np.where(patch[:, None], -truth, truth))
    assert agreement(refined, truth) >= 0.99


def test_only_the_sides_of_given_directions_are_found() -> None:
    rng = np.random.default_rng(3)
    points, truth = torus(800, rng)
    given = truth * rng.choice([-1.0, 1.0], (800, 1))
    normals = oriented_normals(points, along=given).normals
    assert agreement(normals, truth) >= 0.99
    np.testing.assert_allclose(np.abs(np.einsum("ij,ij->i", normals, given)), 1)


def test_winding_number_of_closed_inward_and_open_surfaces() -> None:
    points, truth = sphere(4000, np.random.default_rng(0))
    np.testing.assert_allclose(np.median(winding_at_points(points, truth)), 0.5, atol=0.02)
    assert outwardness(points, truth) == pytest.approx(1, abs=0.04)
    assert outwardness(points, -truth) == pytest.approx(-1, abs=0.04)
    half = points[:, 2] > 0
    # A sphere's kernel is 1 / (2 distance) of the constant sign; half of the surface carries about half of the flux.
    assert 0.3 < outwardness(points[half], truth[half]) < 0.7
    random_signs = np.sign(np.random.default_rng(1).normal(size=(4000, 1)))
    assert winding_disorder(points, truth) < 0.1 < 0.4 < winding_disorder(points, random_signs * truth)
    assert confirmed(points, truth) > 0.95 > 0.5 > confirmed(points, random_signs * truth)
    assert confirmed(points, -truth) < 0.05


@pytest.mark.parametrize("shape", [sphere, torus])
def test_inward_normals_are_flipped_and_outward_ones_are_not(shape: Shape) -> None:
    points, truth = shape(3000, np.random.default_rng(0))
    flipped, was = flip_if_inward(points + UTM, -truth)
    np.testing.assert_array_equal(flipped, truth)
    assert was
    kept, was = flip_if_inward(points + UTM, truth)
    np.testing.assert_array_equal(kept, truth)
    assert not was


def test_open_scans_are_never_flipped() -> None:
    points, truth = sphere(6000, np.random.default_rng(0))
    for bound in (-0.2, 0.0, 0.5):
        seen = points[:, 2] > bound
        assert not flip_if_inward(points[seen], truth[seen])[1]
    bowl = points[:, 2] < 0  # scanned from inside: its normals look at the scanner, into the hollow
    assert not flip_if_inward(points[bowl], -truth[bowl])[1]


def test_a_few_wrong_normals_do_not_flip_the_rest() -> None:
    points, truth = sphere(3000, np.random.default_rng(0))
    wrong = np.where(np.arange(3000)[:, None] % 5 == 0, -truth, truth)
    assert not flip_if_inward(points, wrong)[1]


def table_scene(count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A ball on a plate, as seen from above: without its underside, and no plate below it."""
    ball, outward = sphere(count // 3, rng)
    plate = np.column_stack([rng.uniform(-4, 4, (count, 2)), np.zeros(count)])
    plate = plate[np.hypot(plate[:, 0] + 2, plate[:, 1]) > 1.1]
    seen = ball[:, 2] > -0.3
    truth = np.concatenate([outward[seen], np.tile([0.0, 0, 1], (len(plate), 1))])
    return np.concatenate([ball[seen] * 1.2 + [-2, 0, 1.2], plate]), truth


def waves(count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    x, y = rng.uniform(-5, 5, (2, count))
    slopes = np.column_stack([-np.cos(x), 1.3 * np.sin(1.3 * y), np.ones(count)])
    return np.column_stack([x, y, np.sin(x) + np.cos(1.3 * y)]), slopes / np.linalg.norm(slopes, axis=1, keepdims=True)


@pytest.mark.parametrize("scene", [table_scene, waves])
def test_open_scenes_keep_the_signs_that_neighbours_agree_on(scene: Shape) -> None:
    points, truth = scene(1500, np.random.default_rng(5))
    points += 0.01 * np.random.default_rng(6).standard_normal(points.shape)
    found = oriented_normals(points)
    assert agreement(found.normals, truth) >= 0.99
    assert found.how == "estimated, upward, as of an open surface"
    assert found.confidence is not None
    assert found.confidence > 0.99


def test_neighbours_that_contradict_each_other_are_no_thin_wall(rng: np.random.Generator) -> None:
    points, truth = thin_shell(3000, rng)
    right, mixed = agreement_of(points, truth), agreement_of(points, truth * rng.choice([-1.0, 1.0], (len(truth), 1)))
    assert right.shows_walls() == (right.opposing > 0.02)
    assert right.conflicting < 0.002
    assert not mixed.shows_walls()
    assert mixed.conflicting > 0.1
