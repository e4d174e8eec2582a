"""Estimated normals agree with the analytic ones, in direction and in sign."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from analytic_clouds import sphere, thin_shell, torus

from gnrecon.errors import InputError
from gnrecon.ingest import flip_if_inward, oriented_normals
from gnrecon.ingest.gauss import gauss_normals
from gnrecon.ingest.winding import disorder, outwardness, winding_on_surface

Shape = Callable[[int, np.random.Generator], tuple[np.ndarray, np.ndarray]]
UTM = np.array([431234.123456789, 5412345.987654321, 312.1])


def agreement(normals: np.ndarray, truth: np.ndarray) -> float:
    return float((np.einsum("ij,ij->i", normals, truth) > 0).mean())


@pytest.mark.parametrize("shape", [sphere, torus])
@pytest.mark.parametrize("count", [100, 500, 5000])
@pytest.mark.parametrize("offset", [0.0, UTM])
def test_normals_are_outward(shape: Shape, count: int, offset: float) -> None:
    points, truth = shape(count, np.random.default_rng(count))
    normals, how = oriented_normals(points + offset)
    assert agreement(normals, truth) >= 0.99
    assert np.einsum("ij,ij->i", normals, truth).mean() > (0.9 if count < 500 else 0.97)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1)
    assert how == "estimated"


def test_thin_walls_of_a_sparse_cloud_are_told_apart() -> None:
    points, truth = thin_shell(600, np.random.default_rng(0))
    assert agreement(oriented_normals(points)[0], truth) >= 0.97


def test_several_bodies_all_look_outward() -> None:
    rng = np.random.default_rng(0)
    (a, na), (b, nb) = torus(2000, rng), sphere(1500, rng)
    normals, _ = oriented_normals(np.vstack([a, 0.5 * b + [0, 0, 2.5]]))
    assert agreement(normals, np.vstack([na, nb])) >= 0.99


def test_an_open_scan_looks_at_its_scanner() -> None:
    points, truth = sphere(6000, np.random.default_rng(0))
    seen = points[:, 2] > 0.5
    normals, how = oriented_normals(points[seen])
    assert agreement(normals, truth[seen]) >= 0.99
    assert how == "estimated, orientation uncertain"


def test_a_terrain_looks_upward() -> None:
    x, y = np.random.default_rng(0).uniform(-1, 1, (2, 4000))
    normals, how = oriented_normals(np.column_stack([x, y, 0.1 * np.sin(4 * x) * np.cos(3 * y)]))
    assert (normals[:, 2] > 0).mean() >= 0.99
    assert how == "estimated, orientation uncertain"


def test_the_smallest_clouds_are_served() -> None:
    points, truth = sphere(10, np.random.default_rng(0))
    assert agreement(oriented_normals(points)[0], truth) >= 0.8
    with pytest.raises(InputError, match="from 3 points that span no volume"):
        oriented_normals(points[:3])


def test_estimates_are_reproducible() -> None:
    points = torus(1500, np.random.default_rng(0))[0]
    np.testing.assert_array_equal(oriented_normals(points)[0], oriented_normals(points)[0])


@pytest.mark.parametrize("shape", [sphere, torus])
def test_gauss_formula_gives_directions_and_signs(shape: Shape) -> None:
    points, truth = shape(800, np.random.default_rng(0))
    cosines = np.einsum("ij,ij->i", gauss_normals(points), truth)
    assert (cosines > 0).mean() >= 0.995
    assert cosines.mean() > 0.85


def test_winding_number_of_closed_inward_and_open_surfaces() -> None:
    points, truth = sphere(4000, np.random.default_rng(0))
    np.testing.assert_allclose(np.median(winding_on_surface(points, truth)), 0.5, atol=0.02)
    assert outwardness(points, truth) == pytest.approx(1, abs=0.04)
    assert outwardness(points, -truth) == pytest.approx(-1, abs=0.04)
    half = points[:, 2] > 0
    # A sphere's kernel is 1 / (2 distance) of the constant sign; half of the surface carries about half of the flux.
    assert 0.3 < outwardness(points[half], truth[half]) < 0.7
    random_signs = np.sign(np.random.default_rng(1).normal(size=(4000, 1)))
    assert disorder(points, truth) < 0.1 < 0.4 < disorder(points, random_signs * truth)


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
