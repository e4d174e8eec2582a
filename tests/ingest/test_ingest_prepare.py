"""From clouds and files to samples in the unit ball."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from analytic_clouds import torus
from made_shapes import sphere
from scipy.spatial import cKDTree

from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.ingest import clean, oriented_normals, prepare
from gnrecon.io import read_cloud, read_mesh
from gnrecon.runtime.errors import InputError, UsageError

UTM = np.array([431234.123456789, 5412345.987654321, 312.1])
DATA = Path(os.environ.get("GNRECON_TEST_DATA", Path(__file__).resolve().parents[2] / "../shared/data"))


def stored(name: str) -> Path:
    if not (DATA / name).exists():
        pytest.skip(f"the test data {name} is not here (GNRECON_TEST_DATA names its folder)")
    return DATA / name


def test_samples_are_unit_and_lead_back_to_the_file() -> None:
    points, normals = torus(2000, np.random.default_rng(0))
    samples, counts = prepare(PointCloud(7 * points + UTM, normals))
    np.testing.assert_allclose(samples.points.mean(axis=0), 0, atol=1e-9)
    assert np.linalg.norm(samples.points, axis=1).max() == pytest.approx(1)
    np.testing.assert_allclose(samples.frame.to_world(samples.points), 7 * points + UTM, rtol=0, atol=2e-9)
    np.testing.assert_allclose(samples.normals, normals, atol=1e-12)
    assert (counts.read, counts.kept, counts.thinned, counts.normals) == (2000, 2000, 0, "given")


def test_missing_normals_are_estimated_from_all_points_before_thinning() -> None:
    points, _ = sphere(5000, np.random.default_rng(0))
    samples, counts = prepare(PointCloud(points), max_points=100, subsample="poisson")
    assert (counts.thinned, counts.kept, counts.normals) == (4900, 100, "estimated")
    outward = samples.frame.to_world(samples.points)
    # A fiftieth of the points alone does not determine normals to within three degrees.
    assert np.einsum("ij,ij->i", samples.normals, outward).min() > np.cos(np.radians(3))


def test_inward_normals_are_flipped_and_said_to_be() -> None:
    points, normals = sphere(1000, np.random.default_rng(0))
    samples, counts = prepare(PointCloud(points, -normals))
    np.testing.assert_allclose(samples.normals, normals, atol=1e-12)
    assert counts.remarks() == ["Normals: given, flipped."]


def test_same_seed_same_samples() -> None:
    points, _ = sphere(3000, np.random.default_rng(0))
    first, second, other = (prepare(PointCloud(points), fraction=0.1, seed=seed)[0] for seed in (4, 4, 5))
    np.testing.assert_array_equal(first.points, second.points)
    np.testing.assert_array_equal(first.normals, second.normals)
    assert not np.array_equal(first.points, other.points)


def test_refusals() -> None:
    points, _ = sphere(1000, np.random.default_rng(0))
    with pytest.raises(UsageError, match="leaves 5 points, but a surface needs at least 10"):
        prepare(PointCloud(points), max_points=5)
    with pytest.raises(InputError, match="in one plane"):
        prepare(PointCloud(points * [1, 1, 0]))


@pytest.mark.parametrize(
    ("name", "kept", "dropped", "normals"),
    [
        ("paper/bun_zipper.ply", 34834, {"zero_normals": 1113}, "given"),
        ("paper/rocker-arm.off", 10043, {"outliers": 1}, "given"),
        ("paper/bracket_envelope.stl", 18917, {}, "given"),
        ("srb/gargoyle.ply", 95433, {"outliers": 2}, "given"),
        ("real/chef.pcd", 5092, {}, "given"),
        ("real/car_cloud400.csv", 24989, {"outliers_found": 2142}, "given"),
        ("real/doghead_unoriented.xyz", 1001, {}, "estimated"),
        ("vipss500/kitten.xyz", 500, {}, "estimated"),
    ],
)
def test_real_files(name: str, kept: int, dropped: dict[str, int], normals: str) -> None:
    # The car's normals are inconsistent, and would be estimated again, which takes long.
    samples, counts = prepare(read_cloud(stored(name)), orient="given")
    assert len(samples) == kept
    reasons = ("non_finite", "zero_normals", "duplicates", "outliers", "outliers_found", "thinned")
    assert {key: counts.as_dict()[key] for key in reasons if counts.as_dict()[key]} == dropped
    assert counts.normals == normals
    np.testing.assert_allclose(np.linalg.norm(samples.normals, axis=1), 1)


def test_noise_is_looked_for_where_normals_are_missing() -> None:
    points, normals = torus(500, np.random.default_rng(3))
    height = 0.03 * np.random.default_rng(4).standard_normal((500, 1))
    assert prepare(PointCloud(points))[0].clean is True
    assert prepare(PointCloud(points + height * normals))[0].clean is False
    every = prepare(PointCloud(points))[0]
    assert every.deviations is not None
    # Each deviation stays with its point.
    few = prepare(PointCloud(points), max_points=100, holdout=0.2)[0]
    assert few.deviations is not None
    same = cKDTree(every.frame.to_world(every.points)).query(few.frame.to_world(few.points))[1]
    np.testing.assert_array_equal(few.deviations, every.deviations[same])
    assert len(np.unique(few.deviations)) > 50
    for unknown in (
        prepare(PointCloud(points + height * normals)),
        prepare(PointCloud(points, normals)),
        prepare(PointCloud(points), smooth_scan="3s"),
    ):
        assert unknown[0].deviations is None
    # It is not looked for with given normals, and unknown of points that were moved.
    assert prepare(PointCloud(points, normals))[0].clean is None
    assert prepare(PointCloud(points), smooth_scan="3s")[0].clean is None


def test_estimated_normals_of_few_exact_points_are_those_of_the_smoothest_surface() -> None:
    points, normals = torus(300, np.random.default_rng(3))
    by_winding, found = (
        np.arccos(np.einsum("ij,ij->i", oriented_normals(points, most_points=most).normals, normals).clip(-1, 1))
        for most in (0, 300)
    )
    assert found.mean() < 0.5 * by_winding.mean()


def test_many_points_are_exact_or_it_is_unknown() -> None:
    points, normals = torus(2000, np.random.default_rng(3))
    height = 0.01 * np.random.default_rng(4).standard_normal((2000, 1))
    exact, noisy = (oriented_normals(each, most_points=1000) for each in (points, points + height * normals))
    assert exact.clean is True
    assert noisy.clean is None  # heights of pairs of points decide
    assert exact.deviations is None


@pytest.mark.parametrize("name", ["kitten", "mug"])
def test_real_sparse_clouds_are_oriented_as_the_truth(name: str) -> None:
    points = read_cloud(stored(f"vipss500/{name}.xyz")).points
    truth = read_mesh(stored(f"vipss500/{name}_gt.obj"))
    normals = oriented_normals(points).normals
    expected = truth.vertex_normals()[cKDTree(truth.vertices).query(points)[1]]
    assert (np.einsum("ij,ij->i", normals, expected) > 0).mean() >= 0.99


def test_raw_range_scan_looks_at_its_scanner() -> None:
    scan, _ = clean(read_cloud(stored("real/bunny_scans/bun090.ply")))
    assert scan.normals is None
    found = oriented_normals(scan.points)
    normals, how = found.normals, found.how
    assert (normals[:, 2] > 0).mean() >= 0.99
    assert how == "estimated, orientation uncertain"
