"""Isolated clusters, repeated scans, and the two usual outlier rules."""

from __future__ import annotations

import numpy as np
import pytest
from analytic_clouds import torus
from made_shapes import sphere
from scipy.spatial import cKDTree

from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.ingest import clean, isolated_clusters
from gnrecon.ingest.outliers import OutlierRule, outliers_by_rule, parse_outliers
from gnrecon.ingest.repeated_points import repeated_points
from gnrecon.runtime.errors import UsageError

UTM = np.array([431234.123456789, 5412345.987654321, 312.1])


def blob(count: int, size: float, place: tuple[float, float, float], rng: np.random.Generator) -> np.ndarray:
    return size * rng.normal(size=(count, 3)) + place


@pytest.mark.parametrize("count", [1500, 20_000])
@pytest.mark.parametrize("members", [5, 14])
def test_isolated_clusters_are_found_and_nothing_else(count: int, members: int, rng: np.random.Generator) -> None:
    points = sphere(count, rng)[0]
    dust = np.vstack([blob(members, 0.02, (2, 0, 0), rng), blob(members, 0.02, (0, -2.2, 0.4), rng)])
    mask = isolated_clusters(np.vstack([points, dust]))
    assert mask[count:].all()
    assert not mask[:count].any()


def test_clusters_inside_of_the_shape_are_isolated_too(rng: np.random.Generator) -> None:
    points = sphere(8000, rng)[0]
    mask = isolated_clusters(np.vstack([points, blob(30, 0.02, (0.1, 0, 0), rng)]))
    assert np.flatnonzero(mask).tolist() == list(range(8000, 8030))


def test_parts_that_are_real_stay(rng: np.random.Generator) -> None:
    body = sphere(20_000, rng)[0]
    along = rng.uniform(size=60)
    wire = np.column_stack([1.4 + 0.8 * along, *0.005 * rng.normal(size=(2, 60))])  # its foot was not seen
    strip = np.column_stack([rng.uniform(-0.5, 0.5, 80), rng.uniform(0, 0.02, 80), np.full(80, 1.6)])
    second = 0.2 * sphere(400, rng)[0] + [0, 3, 0]  # one point in fifty, three radii away
    assert not isolated_clusters(np.vstack([body, wire, strip, second])).any()


def test_thinly_scanned_regions_and_scan_lines_stay(rng: np.random.Generator) -> None:
    points = sphere(60_000, rng)[0]
    points = points[rng.uniform(size=60_000) < np.exp(-2.5 * (1 - points[:, 2]))]
    assert not isolated_clusters(points).any()
    height = np.repeat(np.linspace(-0.9, 0.9, 150), 400)
    angle = rng.uniform(0, 2 * np.pi, len(height))
    radius = np.sqrt(1 - height**2)
    lines = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), 20 * height])
    assert not isolated_clusters(lines).any()


def test_clusters_without_any_large_part_stay(rng: np.random.Generator) -> None:
    places = 100 * rng.normal(size=(150, 3))
    scattered = np.vstack([blob(20, 0.1, tuple(place), rng) for place in places])
    assert not isolated_clusters(scattered).any()
    assert not isolated_clusters(scattered[:10]).any()


def test_cluster_modes_and_their_counts(rng: np.random.Generator) -> None:
    points, normals = sphere(8000, rng)
    few = np.vstack([points, blob(30, 0.02, (3, 0, 0), rng)]) + UTM
    many = np.vstack([points, *(blob(60, 0.02, (3, place, 0), rng) for place in range(9))]) + UTM
    cloud = PointCloud(few, np.vstack([normals, normals[:30]]), {"row": np.arange(len(few))})
    kept, counts = clean(cloud)
    np.testing.assert_array_equal(kept.attributes["row"], np.arange(8000))
    assert (counts.clusters, counts.clusters_found, counts.outliers, counts.kept) == (30, 0, 0, 8000)
    assert "Dropped 30 of 8030 points in isolated clusters." in counts.remarks()
    off = clean(PointCloud(few), clusters="off")[1]
    assert (off.clusters, off.clusters_found, off.kept) == (0, 30, 8030)
    assert "Kept 30 points in isolated clusters." in off.remarks()
    assert clean(PointCloud(many), "off")[1].clusters_found == 540
    assert clean(PointCloud(many), "off", clusters="on")[1].clusters == 540
    with pytest.raises(UsageError, match="clusters is 'maybe', but must be one of auto, on, off"):
        clean(PointCloud(few), clusters="maybe")


@pytest.mark.parametrize("copies", [2, 3, 5])
@pytest.mark.parametrize("slip", [1e-9, 3e-5])
def test_a_repeated_scan_is_dropped(copies: int, slip: float, rng: np.random.Generator) -> None:
    points, normals = torus(4000, rng)
    shifted = [points + slip * rng.normal(size=points.shape) for _ in range(1, copies)]
    merged = np.vstack([points, *shifted])
    mask = repeated_points(merged)
    assert mask[:4000].mean() < 0.01  # two points of the scan may be as near by chance
    assert mask[4000:].all()
    counts = clean(PointCloud(merged + UTM, np.vstack([normals] * copies)))[1]
    assert counts.repeated == mask.sum()
    assert f"Dropped {counts.repeated} of {len(merged)} points that repeat another to within rounding" in " ".join(
        counts.remarks()
    )


def test_scans_that_overlap_are_not_repeated(rng: np.random.Generator) -> None:
    assert not repeated_points(np.vstack([torus(4000, rng)[0], torus(4000, rng)[0]])).any()
    points = torus(4000, rng)[0]
    assert not repeated_points(np.vstack([points, points[:50] + 1e-9])).any()
    assert not repeated_points(points[:1]).any()


def test_the_statistical_rule(rng: np.random.Generator) -> None:
    points = np.vstack([sphere(2000, rng)[0], rng.uniform(-2, 2, (20, 3))])
    means = cKDTree(points).query(points, 17)[0].mean(axis=1)
    for deviations in (1.0, 2.5):
        expected = means > means.mean() + deviations * means.std(ddof=1)
        found = outliers_by_rule(points, parse_outliers(f"statistical:{deviations}", None), None)
        np.testing.assert_array_equal(found, expected)
    assert parse_outliers("statistical", None) == OutlierRule("statistical", 2.0)


@pytest.mark.parametrize(("text", "reach"), [("radius:0.1,6", 0.1), ("radius:10cm,6", 0.1)])
def test_the_radius_rule(text: str, reach: float, rng: np.random.Generator) -> None:
    points = np.vstack([sphere(2000, rng)[0], rng.uniform(-2, 2, (20, 3))])
    expected = np.array([len(rows) - 1 < 6 for rows in cKDTree(points).query_ball_point(points, reach)])
    found = outliers_by_rule(points, parse_outliers(text, "m"), "m")
    np.testing.assert_array_equal(found, expected)
    assert 0.1 < expected.mean() < 0.9
    kept, counts = clean(PointCloud(points), text, units="m")
    assert (counts.outliers, len(kept)) == (expected.sum(), (~expected).sum() - counts.clusters)


def test_a_radius_in_spacings(rng: np.random.Generator) -> None:
    points = sphere(2000, rng)[0]
    stray = np.vstack([points, [[3.0, 0, 0], [0, 3, 0]]])
    found = outliers_by_rule(stray, parse_outliers("radius:10s", None), None)
    assert np.flatnonzero(found).tolist() == [2000, 2001]


@pytest.mark.parametrize(
    "text", ["maybe", "statistical:", "statistical:-1", "statistical:nan", "radius", "radius:", "radius:1,0", "on:2"]
)
def test_rules_that_are_none(text: str) -> None:
    with pytest.raises(UsageError, match=r"outlier mode .* is unknown; expected one of auto|is not a length"):
        parse_outliers(text, None)
