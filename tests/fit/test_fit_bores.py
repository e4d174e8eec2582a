"""Walls of round bores, of which pieces were scanned."""

from __future__ import annotations

import numpy as np
import pytest
from made_shapes import bored_plate

from gnrecon.fit import FitOptions, fit
from gnrecon.fit.shape_priors.hole_completion import complete_holes
from gnrecon.geometry.arrays import Float, Mask
from gnrecon.geometry.point_cloud import Frame, Samples

SIDE, HEIGHT = 0.55, 0.4
BORE = 0.08


def block(count: int = 5000, bore: float = BORE, seed: int = 0) -> tuple[Float, Float]:
    """Points and normals of a block with a long narrow bore along z, turned off the axes of lattices."""
    return bored_plate(count, SIDE, HEIGHT, bore, seed)


def on_wall(points: Float, bore: float = BORE) -> Mask:
    mask: Mask = np.hypot(points[:, 0], points[:, 1]) < bore + 1e-9
    return mask


def scanned(points: Float, normals: Float, lower: float, upper: float, bore: float = BORE) -> tuple[Float, Float]:
    """The same without the bore's wall between two heights."""
    kept = ~on_wall(points, bore) | (points[:, 2] < lower) | (points[:, 2] > upper)
    return points[kept], normals[kept]


def turned(points: Float, normals: Float, seed: int) -> tuple[Float, Float, Float]:
    """Both turned, with the rotation that turns them back."""
    back = np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 3)))[0]
    return points @ back.T, normals @ back.T, back


@pytest.mark.parametrize("bore", [0.06, 0.1])
@pytest.mark.parametrize("seed", [0, 1])
def test_a_bore_goes_on_between_pieces_of_its_wall(bore: float, seed: int) -> None:
    whole = scanned(*block(5000, bore, seed), -0.17, 0.15, bore)
    points, normals, back = turned(*whole, seed)
    across = complete_holes(points, normals)
    x, n = across.points @ back, across.normals @ back
    radius = np.hypot(x[:, 0], x[:, 1])
    assert across.holes == 1
    assert np.abs(radius - bore).max() < 2e-3
    # They point to the axis, are all around it, and leave no part of the gap without any.
    np.testing.assert_allclose(-n[:, :2] * bore, x[:, :2], atol=2e-3)
    gap = x[(x[:, 2] > -0.17) & (x[:, 2] < 0.15)]
    assert np.diff(np.sort(gap[:, 2])).max() < bore
    assert np.histogram(np.arctan2(gap[:, 1], gap[:, 0]), bins=6, range=(-np.pi, np.pi))[0].min() > 3
    assert np.abs(x[:, 2]).max() < HEIGHT + 0.02


def test_noise_of_a_good_scanner_hides_no_bore() -> None:
    points, normals = scanned(*block(), -0.1, 0.15)
    rng = np.random.default_rng(2)
    points = points + 0.001 * rng.standard_normal(points.shape)
    normals = normals + 0.04 * rng.standard_normal(normals.shape)
    across = complete_holes(points, normals / np.linalg.norm(normals, axis=1, keepdims=True))
    assert len(across) > 20
    assert np.abs(np.hypot(across.points[:, 0], across.points[:, 1]) - BORE).max() < 5e-3


def test_an_unseen_side_of_the_wall_is_completed() -> None:
    points, normals = block()
    kept = ~on_wall(points) | (points[:, 0] < 0.5 * BORE)
    across = complete_holes(points[kept], normals[kept])
    assert len(across) > 20
    assert np.abs(np.hypot(across.points[:, 0], across.points[:, 1]) - BORE).max() < 2e-3
    assert np.mean(across.points[:, 0] > 0.4 * BORE) > 0.8


def test_air_between_two_lugs_is_no_gap_of_their_bores() -> None:
    lug, normals = bored_plate(3000, SIDE, 0.1, BORE)
    up = np.array([0.0, 0.0, 0.2])
    lugs = np.concatenate([lug + up, lug - up])
    across = complete_holes(lugs, np.concatenate([normals, normals]))
    assert not (np.abs(across.points[:, 2]) < 0.08).any()


def test_blind_bores_at_both_ends_of_a_long_part_stay_apart() -> None:
    points, normals = scanned(*bored_plate(8000, 0.2, 0.6, 0.03), -0.5, 0.5, 0.03)
    across = complete_holes(points, normals)
    assert not (np.abs(across.points[:, 2]) < 0.4).any()


def test_a_bore_ends_at_its_floor() -> None:
    points, normals = scanned(*block(), -HEIGHT, 0.15)
    # The lower half of the block is solid: the bore's lower opening is closed by a face.
    rng = np.random.default_rng(5)
    disk = rng.uniform(-BORE, BORE, (60, 2))
    disk = disk[np.linalg.norm(disk, axis=1) < BORE]
    up = np.tile([0.0, 0.0, 1.0], (len(disk), 1))
    floor, closed = np.column_stack([disk, np.zeros(len(disk))]), np.column_stack([disk, np.full(len(disk), -HEIGHT)])
    points, normals = np.concatenate([points, floor, closed]), np.concatenate([normals, up, -up])
    across = complete_holes(points, normals)
    wall = np.abs(np.hypot(across.points[:, 0], across.points[:, 1]) - BORE) < 2e-3
    assert across.points[wall, 2].max(initial=-1.0) > 0.0
    assert across.points[wall, 2].min() > -0.03


def test_a_groove_is_no_bore() -> None:
    points, normals = scanned(*block(), -0.15, 0.15)
    kept = points[:, 0] < 0.3 * BORE
    rim, count = np.random.default_rng(4).uniform([-SIDE, -HEIGHT], [SIDE, HEIGHT], (1500, 2)), 1500
    rim = rim[np.abs(rim[:, 0]) > BORE]
    count = len(rim)
    cut = np.column_stack([np.full(count, 0.3 * BORE), rim])
    points = np.concatenate([points[kept], cut])
    normals = np.concatenate([normals[kept], np.tile([1.0, 0.0, 0.0], (count, 1))])
    across = complete_holes(points, normals)
    ring = np.abs(np.hypot(across.points[:, 0], across.points[:, 1]) - BORE) < 2e-3
    assert not (ring & (across.points[:, 0] > 0.5 * BORE)).any()


def test_crowded_points_cost_no_memory() -> None:
    points, normals = scanned(*block(), -0.15, 0.15)
    rng = np.random.default_rng(3)
    crowd = np.array([SIDE, 0.0, 0.0]) + 1e-4 * rng.standard_normal((9000, 3))
    across = complete_holes(np.concatenate([points, crowd]), np.concatenate([normals, np.eye(3)[[0] * 9000]]))
    assert len(across) < 3000


def test_points_at_one_place_are_no_bore() -> None:
    points, normals = block(2000)
    crowd = np.full((6000, 3), [SIDE, 0.0, 0.0])
    across = complete_holes(np.concatenate([points, crowd]), np.concatenate([normals, np.eye(3)[[0] * 6000]]))
    assert len(across) < 3000


def test_the_field_is_open_along_the_gap() -> None:
    points, normals = scanned(*block(4000), -0.12, 0.15)
    sdf, _ = fit(Samples(points, normals, Frame(np.zeros(3), 1.0)), FitOptions(seed=0, quality="draft"))
    axis = np.column_stack([np.zeros((20, 2)), np.linspace(-HEIGHT, HEIGHT, 20)])
    assert (sdf.sdf(axis) > 0.2 * BORE).all()
    assert sdf.data is not None
    assert (on_wall(sdf.data) & (np.abs(sdf.data[:, 2]) < 0.1)).any()
