"""The sample scans against the exact shapes they were taken of, and the scanner against a sphere."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from make_sample_data import SAMPLES
from sample_shapes import SHAPES, extrude, gradient, project, smooth_cut, smooth_union
from virtual_scanner import Scanner, scan

from gnrecon.geometry.mesh import Mesh
from gnrecon.io import read_cloud, read_mesh

Float = npt.NDArray[np.float64]


def bounding_radius(mesh: Mesh) -> float:
    return float(np.linalg.norm(np.ptp(mesh.vertices, axis=0))) / 2


def sphere(radius: float) -> Mesh:
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=5, radius=radius)
    return Mesh(np.asarray(ball.vertices) + 1000.0, np.asarray(ball.faces))


def edge_pairs(mesh: Mesh) -> npt.NDArray[np.int64]:
    return mesh.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)


def test_the_folder_stays_small(repository: Path) -> None:
    sizes = {path.name: path.stat().st_size for path in (repository / "sample_data").iterdir()}
    design = {"design_region.stl", "design_interfaces.stl"}
    assert set(sizes) == {*SAMPLES, *design, "README.md", *(f"{name}_reference.ply" for name in SHAPES)}
    assert sum(sizes.values()) < 3_000_000


@pytest.mark.parametrize("name", SHAPES)
def test_references_are_closed_outward_and_on_the_surface(repository: Path, name: str) -> None:
    shape, mesh = SHAPES[name], read_mesh(repository / "sample_data" / f"{name}_reference.ply")
    # Closed and consistently oriented: every directed edge has its opposite, and none occurs twice.
    directed = {tuple(edge) for edge in edge_pairs(mesh).tolist()}
    assert len(directed) == 3 * len(mesh.faces)
    assert all((b, a) in directed for a, b in directed)
    assert mesh.volume > 0
    assert mesh.euler_characteristic == 2 - 2 * shape.genus
    middles = mesh.corners.mean(axis=1)
    assert np.abs(shape.distance(mesh.vertices)).max() < 0.003
    assert np.abs(shape.distance(middles)).mean() < 0.03
    assert np.abs(shape.distance(middles)).max() < 0.2


@pytest.mark.parametrize("file", SAMPLES)
def test_scans_are_as_documented(repository: Path, file: str) -> None:
    sample = SAMPLES[file]
    shape, cloud = SHAPES[sample.shape], read_cloud(repository / "sample_data" / file)
    mesh = read_mesh(repository / "sample_data" / f"{sample.shape}_reference.ply")
    assert len(cloud) == sample.count
    assert not cloud.attributes
    assert (cloud.normals is not None) == sample.normals
    slope = gradient(shape.distance, cloud.points)
    length = np.linalg.norm(slope, axis=1)
    away = np.abs(shape.distance(cloud.points)) / length
    # The noise along the ray, seen at angles of up to 75 degrees, is shorter across the surface: 0.5 to 1 sigma.
    sigma = sample.scanner.noise * bounding_radius(mesh)
    assert 0.5 * sigma < np.median(away) / 0.6745 < sigma
    beyond = np.mean(away > 5 * sigma + 0.05)
    assert abs(beyond - 0.9 * sample.scanner.outliers) <= 0.3 * sample.scanner.outliers + 0.001
    if cloud.normals is not None:
        assert np.allclose(np.linalg.norm(cloud.normals, axis=1), 1.0, atol=1e-5)
        cosine = np.einsum("ij,ij->i", cloud.normals, slope) / length
        assert np.degrees(np.arccos(np.median(cosine))) < (8 if sample.scanner.outliers else 2.5)
        assert np.mean(cosine < 0) <= 0.6 * sample.scanner.outliers


@pytest.mark.parametrize("file", ["bracket_dense.ply", "knot_unoriented.xyz"])
def test_scans_cover_the_surface(repository: Path, file: str) -> None:
    cloud = read_cloud(repository / "sample_data" / file)
    mesh = read_mesh(repository / "sample_data" / f"{SAMPLES[file].shape}_reference.ply")
    from scipy.spatial import KDTree

    gaps = KDTree(cloud.points).query(mesh.corners.mean(axis=1))[0]
    assert np.quantile(gaps, 0.99) < 0.05 * bounding_radius(mesh)


def test_a_perfect_scan_of_a_sphere(rng: np.random.Generator) -> None:
    radius = 7.0
    cloud = scan(sphere(radius), Scanner(pixels=60, noise=0.0, grazing=60.0), 5000, rng)
    assert len(cloud) == 5000
    out = cloud.points - 1000.0
    # The icosphere's faces lie inside by at most the sagitta of its edges.
    assert np.abs(np.linalg.norm(out, axis=1) - radius).max() < 0.002 * radius
    assert cloud.normals is not None
    cosine = np.einsum("ij,ij->i", cloud.normals, out) / np.linalg.norm(out, axis=1)
    assert np.degrees(np.arccos(cosine.min())) < 4.0
    # From every side, so the mean of the points is the middle.
    assert np.abs(out.mean(axis=0)).max() < 0.1 * radius


def test_noise_and_outliers_are_as_large_as_asked(rng: np.random.Generator) -> None:
    radius = 7.0
    bounding = radius * np.sqrt(3.0)
    scanner = Scanner(pixels=80, noise=0.002, reach=4, grazing=30.0, outliers=0.1)
    cloud = scan(sphere(radius), scanner, 6000, rng)
    away = np.linalg.norm(cloud.points - 1000.0, axis=1) - radius
    near = np.abs(away) < 6 * 0.002 * bounding
    assert 0.08 < np.mean(~near) < 0.11
    # Rays within 30 degrees of the normal: 0.93 of the noise on average.
    assert 0.85 < away[near].std() / (0.002 * bounding) < 1.05
    assert np.abs(away).max() <= bounding


def test_the_seed_decides_and_nothing_else() -> None:
    ball, scanner = sphere(1.0), Scanner(pixels=30)
    first, again, other = (scan(ball, scanner, 500, np.random.default_rng(seed)) for seed in (1, 1, 2))
    assert np.array_equal(first.points, again.points)
    assert not np.array_equal(first.points, other.points)


def test_too_few_returns_are_refused(rng: np.random.Generator) -> None:
    with pytest.raises(ValueError, match="fewer than the 100000 points"):
        scan(sphere(1.0), Scanner(pixels=10), 100_000, rng)


def test_smooth_minima_are_exact_away_from_ties_and_fillet_at_them(rng: np.random.Generator) -> None:
    a, b = rng.uniform(-3, 3, (2, 1000))
    union = smooth_union(a, b, 0.5)
    far = np.abs(a - b) >= 0.5
    assert np.array_equal(union[far], np.minimum(a, b)[far])
    assert (union <= np.minimum(a, b)).all()
    assert np.allclose(smooth_union(a, a, 0.5), a - 0.125)
    assert (smooth_cut(a, b, 0.5) >= np.maximum(a, -b)).all()


def test_an_extruded_disc_is_a_rounded_cylinder_s_distance(rng: np.random.Generator) -> None:
    # Off the rim the distance is that to a circle of radius (3 - edge) at height (2 - edge), less the edge.
    points = rng.uniform(2.9, 5.0, (200, 2))
    expected = np.hypot(points[:, 0] - 2.5, points[:, 1] - 1.5) - 0.5
    assert np.allclose(extrude(points[:, 0] - 3.0, points[:, 1], 2.0, 0.5), expected)


@pytest.mark.parametrize("name", SHAPES)
def test_projection_reaches_the_surface(name: str, repository: Path, rng: np.random.Generator) -> None:
    shape, mesh = SHAPES[name], read_mesh(repository / "sample_data" / f"{name}_reference.ply")
    near = mesh.vertices[:500] + rng.uniform(-0.2, 0.2, (500, 3))
    assert np.quantile(np.abs(shape.distance(project(shape.distance, near))), 0.99) < 1e-3
