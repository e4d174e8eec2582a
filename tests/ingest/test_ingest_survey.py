"""The survey of known clouds: noise, state of the normals, and borders."""

from __future__ import annotations

import made_shapes
import numpy as np
import pytest
from analytic_clouds import torus

from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.ingest import prepare
from gnrecon.ingest.line_scans import lie_on_lines
from gnrecon.ingest.repeated_points import repeated_points
from gnrecon.ingest.survey import Survey, fill_a_volume, is_single_sheet, survey


def sphere(rng: np.random.Generator, noise: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    return made_shapes.sphere(6000, rng, noise=noise)


def box(count: int, rng: np.random.Generator) -> np.ndarray:
    points, rows = rng.uniform(-1, 1, (count, 3)), np.arange(count)
    points[rows, rng.integers(0, 3, count)] = rng.choice([-1.0, 1.0], count)
    return points


def facts(points: np.ndarray, normals: np.ndarray | None = None) -> Survey:
    found = survey(PointCloud(points, normals))
    assert found is not None
    return found


def test_noise_and_density_are_among_the_facts(rng: np.random.Generator) -> None:
    found = facts(sphere(rng, 0.01)[0])
    assert found.noise == pytest.approx(0.01, rel=0.1)
    assert found.noise_limit >= found.noise
    assert 1.5 < found.density_variation < 8
    points = sphere(rng)[0]
    uneven = np.vstack([points, 1.0001 * points[points[:, 2] > 0], 1.0002 * points[points[:, 2] > 0]])
    assert facts(uneven + rng.normal(size=uneven.shape) * 0.01).density_variation > 1.5 * found.density_variation


def test_a_scan_that_is_there_twice_is_measured_once(rng: np.random.Generator) -> None:
    points, _ = sphere(rng, 0.005)
    once, twice = facts(points), facts(np.vstack([points, points + 1e-9]))
    assert twice.repeated == pytest.approx(6000, abs=20)
    assert twice.spacing == pytest.approx(once.spacing, rel=0.01)
    assert twice.noise == pytest.approx(once.noise, rel=0.05)
    assert facts(np.vstack([points, 0.01 * points[:20] + [3, 0, 0]])).clusters == 20


def test_the_state_of_normals(rng: np.random.Generator) -> None:
    points, normals = sphere(rng)
    signs = rng.choice([-1.0, 1.0], (len(normals), 1))
    states = {"good": normals, "inward": -normals, "inconsistent": signs * normals, "zero": 0 * normals}
    states["unnormalised"] = 3 * normals
    for state, given in states.items():
        assert facts(points, given).normals == state
    assert facts(points).normals == "missing"


def test_borders_counts_and_extent(rng: np.random.Generator) -> None:
    points, _ = sphere(rng)
    assert not facts(points).open
    half = facts(points[points[:, 2] > 0])
    assert half.open
    assert half.border_share < 0.1
    for closed in (torus(1500, rng)[0], torus(8000, rng)[0], box(3000, rng)):
        assert not facts(closed).open
        assert facts(closed).border_share < 0.004
    mixed = np.vstack([points, points[:7], np.full((3, 3), np.nan), [[9.0, 9, 9]]])
    found = facts(mixed)
    assert (found.points, found.duplicates, found.non_finite, found.outliers) == (6011, 7, 3, 1)
    assert found.upper == [9, 9, 9]
    assert survey(PointCloud(points[:20])) is None


def test_single_sheets_are_terrain_and_walls_not_bowls_or_solids(rng: np.random.Generator) -> None:
    x, y = rng.uniform(-2, 2, (2, 3000))
    slopes = np.column_stack([-np.cos(2 * x), np.sin(y), np.ones(3000)])
    up = slopes / np.linalg.norm(slopes, axis=1, keepdims=True)
    terrain = np.column_stack([x, y, 0.5 * np.sin(2 * x) + np.cos(y)])
    assert is_single_sheet(terrain, up)
    assert is_single_sheet(terrain[:, [2, 0, 1]] + 1e6, up[:, [2, 0, 1]])
    # The walls of a narrow house, with as many points as the ground.
    height, side = rng.uniform(0, 0.5, 3000), rng.choice([-1.0, 1.0], 3000)
    walls = np.column_stack([0.1 * side, rng.uniform(-0.3, 0.3, 3000), height + terrain[:, 2].max()])
    leaning = np.column_stack([side, 0 * side, rng.normal(0, 0.05, 3000)])
    scene = np.concatenate([terrain, walls]), np.concatenate([up, leaning])
    assert (scene[1] @ scene[1].mean(axis=0) > 0).mean() < 0.9
    assert is_single_sheet(*scene)
    assert not is_single_sheet(*scene, least_facing_area=1.0)
    points, outward = sphere(rng)
    half = points[:, 2] > 0
    away = outward / [0.8, 1.1, 0.6]
    face = points * [0.8, 1.1, 0.6], away / np.linalg.norm(away, axis=1, keepdims=True)
    assert is_single_sheet(*(values[points[:, 2] > 0.2] for values in face))
    assert not is_single_sheet(points, outward)
    assert not is_single_sheet(points[half], outward[half])
    assert not is_single_sheet(points[half], -outward[half])
    assert not is_single_sheet(terrain, up * rng.choice([-1.0, 1.0], (3000, 1)))


def test_a_filled_volume_is_its_outer_surface(rng: np.random.Generator) -> None:
    points = sphere(rng)[0][:4000] * rng.random((4000, 1)) ** (1 / 3) * [1.0, 2.0, 1.5] + 10
    samples, counts = prepare(PointCloud(points))
    assert counts.arrangement == "volume"
    assert counts.inner == 4000 - len(samples) > 1000
    assert "The points fill a volume instead of lying on its surface." in " ".join(counts.remarks())
    kept = (samples.frame.to_world(samples.points) - 10) / [1.0, 2.0, 1.5]
    assert np.median(np.linalg.norm(kept, axis=1)) > 0.85
    assert np.linalg.norm(kept, axis=1).min() > 0.6  # inner points that look so by chance are left out
    assert (np.einsum("ij,ij->i", samples.normals, kept) > 0).mean() > 0.95


def test_surfaces_are_neither_lines_nor_volumes(rng: np.random.Generator) -> None:
    grid = np.stack(np.meshgrid(np.arange(40.0), np.arange(40.0)), -1).reshape(-1, 2)
    clouds = [sphere(rng, 0.04)[0], np.column_stack([grid, np.zeros(1600)])]
    clouds.append(np.concatenate([clouds[1], clouds[1] + [0.5, 0.5, 0.3]]))  # both sides of a thin sheet
    for points in clouds:
        assert not lie_on_lines(points)
        assert not fill_a_volume(points)


def test_walls_close_to_each_other_fill_no_volume(rng: np.random.Generator) -> None:
    x = rng.uniform(0.0, 8 * np.pi, (10_000, 3))
    for _ in range(10):  # Newton steps onto a gyroid of four periods
        y, z = np.roll(x, -1, axis=1), np.roll(x, -2, axis=1)
        value, slope = (np.sin(x) * np.cos(y)).sum(axis=1), np.cos(x) * np.cos(y) - np.sin(z) * np.sin(x)
        x = x - (value / (slope**2).sum(axis=1).clip(0.3))[:, None] * slope
    assert np.abs((np.sin(x) * np.cos(np.roll(x, -1, axis=1))).sum(axis=1)).max() < 0.01
    for noise in (0.0, 0.05):
        assert not fill_a_volume(x - x.mean(axis=0) + noise * rng.standard_normal(x.shape))
    assert fill_a_volume(rng.uniform(-1.0, 1.0, (10_000, 3)))


def test_overlapping_strips_are_no_repeated_scan(rng: np.random.Generator) -> None:
    """Two surveys of one terrain that share a strip, in which one point in eight lies close to one of the other."""
    first, second = rng.uniform(0, 1, (2, 3000, 3)) * [1, 1, 0.01]
    second[:, 0] += 0.7
    strip = np.flatnonzero(first[:, 0] > 0.7)[::2]
    second[: len(strip)] = first[strip] + 1e-5
    assert not repeated_points(np.concatenate([first, second])).any()
    part = first[first[:, 0] > 0.7]
    assert repeated_points(np.concatenate([first, part + 1e-5])).sum() == pytest.approx(len(part), rel=0.01)
