"""Samplers, and the coarse signed distance of closed, open and ring-shaped clouds against exact distances."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from made_shapes import sphere
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gnrecon.geometry.signed_distance import (
    Box,
    CoarseDistance,
    film_distance,
    kd_tree_order,
    sample_near_surface,
    winding_number,
)

Float = NDArray[np.float64]
Shape = Callable[[int], tuple[Float, Float]]
Distance = Callable[[Float], Float]

MAJOR, MINOR = 0.7, 0.25


def torus(count: int, seed: int = 0) -> tuple[Float, Float]:
    """Points of a torus, uniform in area by rejection."""
    rng = np.random.default_rng(seed)
    around, tube = rng.uniform(0, 2 * np.pi, (2, 4 * count))
    kept = rng.uniform(0, MAJOR + MINOR, 4 * count) < MAJOR + MINOR * np.cos(tube)
    around, tube = around[kept][:count], tube[kept][:count]
    outward = np.stack([np.cos(around), np.sin(around), np.zeros(len(around))], axis=1)
    normals = np.cos(tube)[:, None] * outward + np.sin(tube)[:, None] * [0.0, 0.0, 1.0]
    return MAJOR * outward + MINOR * normals, normals


def sphere_distance(x: Float) -> Float:
    return np.linalg.norm(x, axis=1) - 1.0


def torus_distance(x: Float) -> Float:
    return np.hypot(np.hypot(x[:, 0], x[:, 1]) - MAJOR, x[:, 2]) - MINOR


def test_box() -> None:
    points = np.array([[0.0, 1.0, -2.0], [3.0, -1.0, 5.0]])
    box = Box.around(points, 0.5)
    assert box.lower.tolist() == [-0.5, -1.5, -2.5]
    assert box.upper.tolist() == [3.5, 1.5, 5.5]
    drawn = box.sample(20_000, np.random.default_rng(0))
    assert drawn.shape == (20_000, 3)
    assert np.all((drawn >= box.lower) & (drawn <= box.upper))
    # The mean of a uniform variable is known to width / sqrt(12 n): four of these.
    width = box.upper - box.lower
    assert np.all(np.abs(drawn.mean(axis=0) - (box.lower + box.upper) / 2) < 4 * width / np.sqrt(12 * 20_000))
    assert np.allclose(drawn.var(axis=0), width**2 / 12, rtol=0.05)


def test_near_surface() -> None:
    points, _ = sphere(50)
    drawn = sample_near_surface(points, 1e-6, 3000, np.random.default_rng(1))
    assert drawn.shape == (3000, 3)
    gaps = np.linalg.norm(drawn[:, None] - points, axis=2)
    nearest = gaps.argmin(axis=1)
    assert np.bincount(nearest, minlength=50).min() > 20, "every data point is drawn"
    offsets = drawn - points[nearest]
    assert offsets.std() == pytest.approx(1e-6, rel=0.05)
    assert abs(offsets.mean()) < 1e-7


def test_samplers_follow_their_generator() -> None:
    points, _ = sphere(50)
    box = Box.around(points, 0.1)
    for draw in (
        lambda seed: box.sample(10, np.random.default_rng(seed)),
        lambda seed: sample_near_surface(points, 0.1, 10, np.random.default_rng(seed)),
    ):
        assert np.array_equal(draw(3), draw(3))
        assert not np.array_equal(draw(3), draw(4))


@pytest.mark.parametrize("count", [600, 3000, 6000])
def test_coarse_distance_of_a_sphere(count: int) -> None:
    coarse = CoarseDistance(*sphere(count), np.random.default_rng(0))
    # A random point's nearest of n on an area A lies sqrt(A ln 2 / (pi n)) away in the median.
    assert coarse.spacing == pytest.approx(np.sqrt(4 * np.log(2) / count), rel=0.1)
    x = np.random.default_rng(1).uniform(-1.3, 1.3, (4000, 3))
    known, distance = coarse.sample(x)
    truth = sphere_distance(known)
    assert np.array_equal(np.sign(distance), np.sign(truth))
    assert len(known) == len(distance)
    far = np.abs(truth) > 0.2
    assert np.median(np.abs(distance / truth - 1)[far]) < 0.02
    # A gap between random points can be several spacings wide, and there the nearest point is far off the foot.
    assert np.abs(distance - truth).max() < 4 * coarse.spacing


@pytest.mark.parametrize(
    ("shape", "exact", "count"),
    [(sphere, sphere_distance, 600), (sphere, sphere_distance, 3000), (torus, torus_distance, 5000)],
)
def test_coarse_distance_is_not_biased_by_the_gaps(shape: Shape, exact: Distance, count: int) -> None:
    """Near the data the nearest point is a quarter of a spacing farther than the surface; the distance must not be."""
    points, normals = shape(count)
    coarse = CoarseDistance(points, normals, np.random.default_rng(0))
    known, distance = coarse.sample(np.random.default_rng(1).uniform(-1.2, 1.2, (20_000, 3)))
    truth = np.abs(exact(known))
    near = truth < 5 * coarse.spacing
    nearest = cKDTree(points).query(known[near])[0]
    assert (nearest - truth[near]).mean() > 0.2 * coarse.spacing
    assert abs((np.abs(distance) - truth)[near].mean()) < 0.08 * coarse.spacing


def test_coarse_distance_answers_all_but_the_shell_around_the_data() -> None:
    coarse = CoarseDistance(*sphere(3000), np.random.default_rng(0))
    x = np.random.default_rng(1).uniform(-1.3, 1.3, (4000, 3))
    known, _ = coarse.sample(x)
    answered = (x[:, None, 0] == known[None, :, 0]).any(axis=1)
    assert np.all(answered[np.abs(sphere_distance(x)) > 5 * coarse.spacing])
    on_the_data, distance = coarse.sample(sphere(100)[0])
    assert on_the_data.shape == (0, 3)
    assert distance.shape == (0,)


def test_coarse_distance_of_a_torus() -> None:
    """The hole is outside, though the nearest normals face it from all around."""
    coarse = CoarseDistance(*torus(5000), np.random.default_rng(0))
    x = np.random.default_rng(1).uniform(-1.1, 1.1, (4000, 3)) * [1.0, 1.0, 0.5]
    known, distance = coarse.sample(x)
    truth = torus_distance(known)
    assert np.count_nonzero(truth < 0) > 300
    assert np.array_equal(np.sign(distance), np.sign(truth))
    assert np.abs(distance - truth).max() < 4 * coarse.spacing
    assert coarse.sample(np.zeros((1, 3)))[1] == pytest.approx(MAJOR - MINOR, rel=0.02)


def test_an_open_hemisphere_holds_what_its_cap_holds() -> None:
    points, normals = sphere(4000)
    upper = points[:, 2] > 0
    coarse = CoarseDistance(points[upper], normals[upper], np.random.default_rng(0))
    inside = np.array([[0.0, 0.0, 0.5], [0.3, 0.2, 0.4], [0.0, -0.4, 0.6]])
    # Behind the scan, where the nearest normals point away, as well as in front of it.
    outside = np.array([[0.0, 0.0, -0.8], [0.0, 0.0, -1.3], [0.9, 0.0, -0.9], [0.0, 0.0, 1.4], [1.5, 0.3, 0.2]])
    assert np.all(coarse.sample(inside)[1] < 0)
    assert np.all(coarse.sample(outside)[1] > 0)
    # At the centre of its rim a hemisphere fills half of all directions.
    assert coarse.winding_number(np.zeros((1, 3))) == pytest.approx(0.5, abs=0.02)


def test_a_film_closes_an_open_hemisphere_flat() -> None:
    points, normals = sphere(4000)
    upper = points[:, 2] > 0
    coarse = CoarseDistance(points[upper], normals[upper], np.random.default_rng(0))
    heights = np.linspace(0.05, 0.8, 16)
    known, signed, _, winding = coarse.at(np.column_stack([np.zeros((16, 2)), -heights]))
    # The rim is at a distance of one and more.
    assert known.all()
    assert (signed > 0.9).all()
    np.testing.assert_allclose(film_distance(signed, winding), heights, atol=0.045)


@pytest.mark.parametrize(("shape", "distance"), [(sphere, sphere_distance), (torus, torus_distance)])
def test_winding_number_away_from_the_data(shape: Shape, distance: Distance) -> None:
    coarse = CoarseDistance(*shape(4000), np.random.default_rng(0))
    x = np.random.default_rng(1).uniform(-1.2, 1.2, (3000, 3))
    truth = distance(x)
    winding = coarse.winding_number(x)
    for side, expected in ((truth < -0.12, 1.0), (truth > 0.12, 0.0)):
        assert np.count_nonzero(side) > 40
        assert np.abs(winding[side] - expected).max() < 0.15
        assert np.abs(winding[side] - expected).mean() < 0.06


def test_winding_number_against_the_plain_sum_of_dipoles() -> None:
    """Batches and expanded squares change nothing, single precision little, and orientation decides the sign."""
    points, normals = sphere(500)
    coarse = CoarseDistance(points, normals, np.random.default_rng(0))
    x = np.random.default_rng(1).uniform(-1.5, 1.5, (37, 3))
    x = x[np.abs(sphere_distance(x)) > 0.3]
    gaps = np.linalg.norm(points[:, None] - points, axis=2)
    areas = np.pi * np.sort(gaps, axis=1)[:, 8] ** 2 / 8
    arms = points - x[:, None]
    flux = np.einsum("qjc,jc->qj", arms, normals) / np.linalg.norm(arms, axis=2) ** 3
    plain = (flux * areas).sum(axis=1) / (4 * np.pi)
    terms = points, normals * (areas / (4 * np.pi))[:, None], np.sqrt(areas / np.pi)
    assert np.allclose(winding_number(x, *terms), plain, rtol=1e-9, atol=1e-12)
    assert np.allclose(winding_number(x, *terms, batch_terms=2500, least_batch=1), plain, rtol=1e-9, atol=1e-12)
    assert np.allclose(coarse.winding_number(x), plain, rtol=1e-4, atol=1e-6)
    assert coarse.winding_number(x[:0]).shape == (0,)
    inward = CoarseDistance(points, -normals, np.random.default_rng(0))
    assert np.allclose(inward.winding_number(x), -plain, rtol=1e-4, atol=1e-6)


def test_a_large_cloud_is_summed_by_a_subset() -> None:
    """9,000 points are more than the sum takes; the subset's areas must make up for the rest."""
    coarse = CoarseDistance(*sphere(9000), np.random.default_rng(0))
    assert coarse.winding_number(np.zeros((1, 3))) == pytest.approx(1.0, abs=0.05)


def test_halved_points_come_in_compact_patches() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(size=(1000, 3)) * [4.0, 2.0, 0.0]
    order = kd_tree_order(points)
    assert sorted(order) == list(range(1000))
    # Runs of 8 and 64 points of a plane, 125 to a unit of area: their patches are about square.
    for length in (8, 64):
        sides = [np.ptp(points[order][start : start + length], axis=0).max() for start in range(0, 1000, length)]
        assert np.mean(sides) < 1.6 * np.sqrt(length / 125)
    assert np.array_equal(kd_tree_order(points), order)


@pytest.mark.parametrize("count", [0, 1, 2, 5, 9])
def test_few_or_equal_points_are_halved(count: int) -> None:
    assert sorted(kd_tree_order(np.random.default_rng(count).normal(size=(count, 3)))) == list(range(count))
    assert sorted(kd_tree_order(np.ones((count, 3)))) == list(range(count))
