"""Normals of the smoothest surface through points, and whether their noise is likelier."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_shapes import box, sphere, torus

from gnrecon.geometry.arrays import Float
from gnrecon.geometry.signed_distance import Density
from gnrecon.geometry.spline_patches import SmoothestNormals, SplineParameters, smoothest_normals
from gnrecon.runtime.parallel import fixed_sums


def ellipsoid(count: int, axes: tuple[float, float, float], seed: int = 0) -> tuple[Float, Float]:
    points, _ = sphere(count, seed)
    points = points * axes
    normals = points / np.square(axes)
    return points, normals / np.linalg.norm(normals, axis=1, keepdims=True)


def rough(normals: Float, degrees: float, seed: int = 1) -> Float:
    """Return normals tilted at random by about so many degrees."""
    tilted = normals + np.radians(degrees) / 2**0.5 * np.random.default_rng(seed).standard_normal(normals.shape)
    return np.asarray(tilted / np.linalg.norm(tilted, axis=1, keepdims=True))


def off(normals: Float, exact: Float) -> float:
    """Return the mean angle between unit normals, in degrees."""
    return float(np.degrees(np.arccos(np.einsum("nd,nd->n", normals, exact).clip(-1, 1))).mean())


def smoothest(points: Float, normals: Float) -> SmoothestNormals:
    found = smoothest_normals(points, normals)
    assert found is not None, "the points have no noise"
    np.testing.assert_allclose(np.linalg.norm(found.normals, axis=1), 1.0)
    return found


def found(points: Float, normals: Float) -> Float:
    return smoothest(points, normals).normals


SHAPES = {
    "ellipsoid": ellipsoid(400, (1.0, 0.7, 0.5)),
    "leaf": ellipsoid(500, (1.0, 0.7, 0.1)),
    "ring as thin as points are apart": torus(300, 2, 1.0, 0.12),
}


@pytest.mark.parametrize("shape", SHAPES)
def test_normals_are_nearer_than_the_first_guess(shape: str) -> None:
    points, exact = SHAPES[shape]
    guess = rough(exact, 20.0)
    assert off(found(points, guess), exact) < 0.4 * off(guess, exact)


@pytest.mark.parametrize(
    ("shape", "disk_radii"), [("ellipsoid", 0.15), ("leaf", 0.3), ("ring as thin as points are apart", 0.4)]
)
def test_noise_is_seen_on_thin_and_thick_shapes(shape: str, disk_radii: float) -> None:
    points, exact = SHAPES[shape]
    height = disk_radii * Density(points).radius * np.random.default_rng(3).standard_normal(len(points))
    assert smoothest_normals(points + height[:, None] * exact, rough(exact, 20.0)) is None


def test_a_thin_part_of_a_thick_shape_is_no_noise() -> None:
    """One amplitude for all would be that of the ball, under which the ring is too curved."""
    ball, ring = sphere(700, 4), torus(250, 5, 1.6, 0.07)
    points, exact = (np.vstack(both) for both in zip(ball, ring, strict=True))
    turned = found(points, rough(exact, 15.0))
    assert off(turned[:700], exact[:700]) < 1.0
    assert off(turned, exact) < 0.5 * off(rough(exact, 15.0), exact)


def test_faces_stay_flat_and_edges_are_no_noise() -> None:
    points, exact = box(800, np.random.default_rng(6), (1.0, 0.8, 0.6))
    turned = found(points, rough(exact, 10.0))
    assert np.median(np.degrees(np.arccos(np.einsum("nd,nd->n", turned, exact).clip(-1, 1)))) < 1.0


def rugged_ball(count: int, seed: int) -> tuple[Float, Float]:
    """Points of a ball with heights of all wavelengths: the spectrum is the spline's, k^-6."""
    u, _ = sphere(count, seed)
    rng = np.random.default_rng(seed)
    waves = rng.standard_normal((200, 3))
    size = np.exp(rng.uniform(np.log(2.0), np.log(40.0), 200))
    waves *= (size / np.linalg.norm(waves, axis=1))[:, None]
    phases = u @ waves.T + rng.uniform(0, 2 * np.pi, 200)
    height = 1.0 + 0.05 * np.sin(phases) @ size**-1.5
    slope = 0.05 * np.cos(phases) @ (size[:, None] ** -1.5 * waves)
    across = slope - np.einsum("nd,nd->n", slope, u)[:, None] * u
    normals = u - across / height[:, None]
    return height[:, None] * u, normals / np.linalg.norm(normals, axis=1, keepdims=True)


@pytest.mark.parametrize("count", [300, 1000])
def test_deviations_are_as_large_as_errors(count: int) -> None:
    points, exact = rugged_ball(count, 2)
    turned = smoothest(points, rough(exact, 20.0))
    # An error has two components, one along each tangent.
    errors = np.arccos(np.einsum("nd,nd->n", turned.normals, exact).clip(-1, 1)) / 2**0.5
    assert 0.4 < np.sqrt(np.mean((errors / turned.deviations) ** 2)) < 2.0


def test_normals_near_edges_are_less_sure_than_those_of_faces() -> None:
    points, exact = box(800, np.random.default_rng(6), (1.0, 0.8, 0.6))
    turned = smoothest(points, rough(exact, 10.0))
    errors = np.degrees(np.arccos(np.einsum("nd,nd->n", turned.normals, exact).clip(-1, 1)))
    sure, unsure = np.array_split(np.argsort(turned.deviations), 2)
    assert np.mean(errors[unsure] ** 2) > 10 * np.mean(errors[sure] ** 2)
    assert turned.deviations.max() <= 1.0


def test_large_scans_show_their_noise_in_some_regions() -> None:
    points, exact = ellipsoid(3000, (1.0, 0.7, 0.5))
    guess = rough(exact, 20.0)
    few = replace(SplineParameters(), regions=2, region_points=100)
    turned = smoothest_normals(points, guess, parameters=few)
    assert turned is not None
    # All normals are those of the surface, not only the regions'.
    assert np.quantile(np.einsum("nd,nd->n", turned.normals, exact), 0.001) > np.cos(np.radians(5))
    assert turned.deviations.shape == (3000,)
    height = 0.3 * Density(points).radius * np.random.default_rng(3).standard_normal(len(points))
    assert smoothest_normals(points + height[:, None] * exact, guess, parameters=few) is None


@pytest.mark.parametrize("count", [10, 17])
def test_few_points_are_one_patch(count: int) -> None:
    points, exact = sphere(count, 7)
    turned = smoothest_normals(points, exact)
    assert turned is None or off(turned.normals, exact) < 30.0


@pytest.mark.parametrize(("scale", "offset"), [(1e-9, 0.0), (1e150, 0.0), (1.0, 1e4)])
def test_unit_and_place_do_not_count(scale: float, offset: float) -> None:
    points, exact = SHAPES["ellipsoid"]
    guess = rough(exact, 20.0)
    moved = found(scale * points + offset, guess)
    assert off(moved, found(points, guess)) < 0.01


def test_points_that_nearly_coincide_are_allowed() -> None:
    points, exact = SHAPES["ellipsoid"]
    guess, twice = rough(exact, 20.0), np.r_[: len(points), :40]
    assert off(found(points[twice] * (1 + 1e-12 * np.arange(len(twice)))[:, None], guess[twice]), exact[twice]) < 3.0


def test_a_sheet_that_is_exactly_flat_keeps_its_normals() -> None:
    points = np.random.default_rng(8).uniform(-1, 1, (300, 3)) * [1.0, 1.0, 0.0]
    up = np.tile([0.0, 0.0, 1.0], (300, 1))
    assert off(found(points, up), up) < 0.1
    assert off(found(points, rough(up, 20.0)), up) < 1.0


def test_results_do_not_depend_on_the_number_of_threads() -> None:
    points, exact = SHAPES["leaf"]
    several = []
    for threads in (1, 2):
        with fixed_sums(threads):
            several.append(found(points, rough(exact, 20.0)))
    np.testing.assert_array_equal(*several)
