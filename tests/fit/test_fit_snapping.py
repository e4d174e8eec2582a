"""Noisy points are snapped to the primitives from which they cannot be distinguished, and only there."""

from __future__ import annotations

import made_shapes
import numpy as np
import pytest
from made_shapes import bored_plate

from gnrecon.fit.shape_priors.bilateral_filter import BilateralFilter
from gnrecon.fit.shape_priors.prior_parameters import SharpShapeParameters
from gnrecon.fit.shape_priors.snapping import SnappedPoints, snap_to_primitives
from gnrecon.geometry.arrays import Float

SIDE, HEIGHT, BORE, NOISE = 0.7, 0.2, 0.12, 0.006

AVERAGING = BilateralFilter(SharpShapeParameters.averaging_width_radii, SharpShapeParameters.averaging_normal_scale)
Oriented = tuple[Float, Float]


def noisy(scan: Oriented, noise: float = NOISE, tilt: float = 0.15) -> Oriented:
    """Move points along their normals, and tilt these, in radians."""
    rng = np.random.default_rng(7)
    normals = scan[1] + tilt * rng.standard_normal(scan[1].shape)
    moved = scan[0] + noise * rng.standard_normal((len(scan[0]), 1)) * scan[1]
    return moved, normals / np.linalg.norm(normals, axis=1, keepdims=True)


def cube(count: int) -> Oriented:
    return made_shapes.cube(count, SIDE)


def bored(count: int) -> Oriented:
    return bored_plate(count, SIDE, HEIGHT, BORE, seed=1)


def ball(count: int) -> Oriented:
    return made_shapes.sphere(count, 2, SIDE)


def torus(count: int) -> Oriented:
    return made_shapes.torus(count, 3, SIDE, 0.35 * SIDE)


def bulged(count: int, by: float) -> tuple[Oriented, np.ndarray]:
    """Draw points of a cube whose upper face bulges, and which of them are on that."""
    x, normals = cube(count)
    upper = normals[:, 2] > 0.5
    across = x[upper, :2] / SIDE
    x[upper, 2] += by * np.prod(1 - across**2, axis=1)
    normals[upper, :2] = 2 * by / SIDE * across * (1 - across[:, ::-1] ** 2)
    normals[upper] /= np.linalg.norm(normals[upper], axis=1, keepdims=True)
    return (x, normals), upper


def of(scan: Oriented) -> SnappedPoints | None:
    return snap_to_primitives(*scan, AVERAGING.apply(*scan))


def test_faces_of_a_cube_are_known_far_better_than_an_average_knows_them() -> None:
    exact = cube(3000)
    scan = noisy(exact)
    found = of(scan)
    assert found is not None
    assert found.on_primitive.mean() > 0.95
    assert found.primitives == 6
    axis = np.abs(exact[1]).argmax(axis=1)

    def off(points: Float) -> float:
        return float(np.abs(np.abs(np.take_along_axis(points, axis[:, None], 1)) - SIDE).mean())

    averaged, _ = AVERAGING.apply(*scan)
    assert off(found.points) < 0.5 * off(averaged) < 0.25 * off(scan[0])
    turned = np.einsum("nd,nd->n", found.normals[found.on_primitive], exact[1][found.on_primitive])
    assert np.degrees(np.arccos(turned.clip(-1, 1))).max() < 0.5


def test_a_bore_narrower_than_what_is_averaged_is_found_in_what_is_left() -> None:
    exact = bored(4000)
    scan = noisy(exact)
    found = of(scan)
    assert found is not None
    wall = (np.hypot(*exact[0][:, :2].T) < BORE + 1e-9) & (np.abs(exact[1][:, 2]) < 0.5)
    assert wall.sum() > 100
    assert found.on_primitive[wall].mean() > 0.9

    def off(points: Float) -> Float:
        return np.abs(np.hypot(*points[wall & found.on_primitive, :2].T) - BORE)

    assert off(found.points).mean() < 0.3 * off(scan[0]).mean()
    assert np.einsum("nd,nd->n", found.normals, exact[1])[wall & found.on_primitive].mean() > 0.995


def test_exact_points_stay_and_their_tilted_normals_are_righted() -> None:
    exact = cube(3000)
    found = of(noisy(exact, noise=0.0, tilt=0.25))
    assert found is not None
    on = found.on_primitive
    assert on.mean() > 0.9
    np.testing.assert_allclose(found.points[on], exact[0][on], atol=1e-3)
    turned = np.einsum("nd,nd->n", found.normals, exact[1])[on]
    assert np.mean(turned > 1 - 1e-5) > 0.99  # except some near an edge


def test_no_point_is_snapped_beyond_an_edge() -> None:
    """Noise in all directions takes points of a face beyond its edge; snapped there, they would leave fragments."""
    exact = cube(3000)
    scan = noisy(exact)
    points = scan[0] + NOISE * np.random.default_rng(8).standard_normal((3000, 3))
    found = of((points, scan[1]))
    assert found is not None
    beyond = np.sort(np.abs(points), axis=1)[:, 1] > SIDE
    assert beyond.sum() > 10
    assert np.abs(found.points[found.on_primitive]).max() < SIDE + 0.6 * NOISE


def test_single_points_farther_off_than_noise_is_are_snapped_too() -> None:
    exact = cube(3000)
    points, normals = noisy(exact)
    rows = np.arange(0, 3000, 60)
    points[rows] = exact[0][rows] + 4.5 * NOISE * exact[1][rows]
    found = of((points, normals))
    assert found is not None
    axis = np.abs(exact[1][rows]).argmax(axis=1)[:, None]
    off = np.abs(np.abs(np.take_along_axis(found.points[rows], axis, 1)[:, 0]) - SIDE)
    assert np.mean(found.on_primitive[rows] & (off < 0.2 * NOISE)) > 0.9


@pytest.mark.parametrize("by", [2 * NOISE, 5 * NOISE, 10 * NOISE, 20 * NOISE])
def test_a_face_that_bulges_is_not_flattened(by: float) -> None:
    """Averaging keeps the bulge; pieces of cylinders, which noise does not rule out, would miss half of it."""
    exact, upper = bulged(4000, by)
    scan = noisy(exact)
    found = of(scan)
    assert found is not None
    assert found.on_primitive[~upper].mean() > 0.95

    def off(points: Float) -> float:
        x, y, z = points[upper].T
        return float(np.abs(z - SIDE - by * (1 - (x / SIDE) ** 2) * (1 - (y / SIDE) ** 2)).mean())

    assert off(found.points) < 1.3 * off(AVERAGING.apply(*scan)[0]) < 0.6 * off(scan[0])


def test_a_noisy_ball_is_a_sphere() -> None:
    found = of(noisy(ball(3000)))
    assert found is not None
    assert found.primitives == 1
    assert found.on_primitive.mean() > 0.99
    assert np.abs(np.linalg.norm(found.points[found.on_primitive], axis=1) - SIDE).max() < 0.15 * NOISE


@pytest.mark.parametrize("scan", [torus(3000), torus(400), cube(8)])
def test_other_shapes_and_a_few_points_are_left_alone(scan: Oriented) -> None:
    assert of(noisy(scan)) is None


def test_what_averaging_moves_farther_than_noise_does_stays_where_it_was() -> None:
    scan = noisy(cube(3000))
    averaged = AVERAGING.apply(*scan)
    apart = 0.3 * np.ones(3)
    points, normals = (np.concatenate([one, [other]]) for one, other in zip(scan, (apart, scan[1][0]), strict=True))
    moved = np.concatenate([averaged[0], [apart + 0.1]]), np.concatenate([averaged[1], [scan[1][0]]])
    found = snap_to_primitives(points, normals, moved)
    assert found is not None
    assert not found.on_primitive[-1]
    np.testing.assert_array_equal(found.points[-1], apart)
