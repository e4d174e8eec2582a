"""Cleaning: what is dropped, the counts by reason, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_shapes import sphere

from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.ingest import IngestCounts, clean, find_outliers
from gnrecon.runtime.errors import InputError, UsageError

UTM = np.array([431234.123456789, 5412345.987654321, 312.1])


def test_every_reason_is_counted_and_attributes_follow() -> None:
    points, normals = sphere(200, np.random.default_rng(0))
    points, normals = points.copy(), 3 * normals
    points[3, 1] = np.nan
    points[4] = [np.inf, 0, 0]
    points[50] = points[60] = points[10]
    normals[7] = 0
    normals[8, 2] = np.nan
    label = np.arange(200)
    cloud, counts = clean(PointCloud(points, normals, {"label": label}), "off")
    assert counts == IngestCounts(
        read=200, non_finite=2, zero_normals=2, duplicates=2, kept=194, normals="given", outliers_found=0
    )
    kept = np.setdiff1d(label, [3, 4, 7, 8, 50, 60])
    np.testing.assert_array_equal(cloud.attributes["label"], kept)
    np.testing.assert_array_equal(cloud.points, points[kept])
    assert cloud.normals is not None
    np.testing.assert_allclose(cloud.normals, normals[kept] / 3, atol=1e-15)
    assert counts.remarks() == [
        "Dropped 2 of 200 points with a coordinate that is not finite or out of all proportion.",
        "Dropped 2 of 200 points with a zero or non-finite normal.",
        "Dropped 2 of 200 points that duplicate another.",
    ]
    assert counts.as_dict()["duplicates"] == 2


def test_normals_that_are_mostly_zero_are_discarded_instead_of_the_points() -> None:
    points, normals = sphere(100, np.random.default_rng(0))
    cloud, counts = clean(PointCloud(points, np.where(np.arange(100)[:, None] < 60, 0, normals)))
    assert cloud.normals is None
    assert (counts.kept, counts.zero_normals, counts.normals) == (100, 0, "missing")


@pytest.mark.parametrize("length", [1e-200, 1e-3, 1e200])
def test_normals_of_any_length_become_unit(length: float) -> None:
    points, normals = sphere(50, np.random.default_rng(0))
    cloud, _ = clean(PointCloud(points, length * normals))
    np.testing.assert_allclose(cloud.normals, normals, atol=1e-12)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), offset=st.sampled_from([0.0, UTM]), scale=st.sampled_from([0.01, 1.0, 100.0]))
def test_cleaning_twice_changes_nothing_more(seed: int, offset: float, scale: float) -> None:
    rng = np.random.default_rng(seed)
    points, normals = sphere(300, rng)
    points = np.vstack([points, rng.uniform(-2, 2, (5, 3)), points[:7]]) * scale + offset
    once, counts = clean(PointCloud(points, np.vstack([normals, normals[:12]])))
    twice, again = clean(once)
    np.testing.assert_array_equal(twice.points, once.points)
    assert counts.duplicates == 7
    assert (again.read, again.kept, again.duplicates) == (counts.kept, counts.kept, 0)


def test_few_points_are_refused() -> None:
    points = sphere(9, np.random.default_rng(0))[0]
    with pytest.raises(InputError, match="Only 9 of 9 points are usable, but a surface needs at least 10"):
        clean(PointCloud(points))
    with pytest.raises(InputError, match="Only 1 of 40 points"):
        clean(PointCloud(np.ones((40, 3))))
    with pytest.raises(InputError, match="Only 0 of 0 points"):
        clean(PointCloud(np.empty((0, 3))))
    with pytest.raises(InputError, match="Only 0 of 40 points"):
        clean(PointCloud(np.full((40, 3), np.nan)))


@pytest.mark.parametrize("offset", [np.zeros(3), UTM])
def test_flat_clouds_are_refused_and_thin_ones_are_not(offset: np.ndarray) -> None:
    rng = np.random.default_rng(0)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    box = rng.uniform(size=(500, 3)) * 100
    with pytest.raises(InputError, match="on one line"):
        clean(PointCloud(box * [1, 0, 0] @ turn + offset))
    with pytest.raises(InputError, match="in one plane"):
        clean(PointCloud(box * [1, 1, 0] @ turn + offset))
    assert len(clean(PointCloud(box * [1, 1, 0.001] @ turn + offset), "off")[0]) == 500


def scattered(count: int, rng: np.random.Generator) -> np.ndarray:
    """Stray points in a box around the unit ball, all well off the surface."""
    stray = rng.uniform(-1.5, 1.5, (20 * count, 3))
    return stray[np.abs(np.linalg.norm(stray, axis=1) - 1) > 0.25][:count]


@pytest.mark.parametrize("share", [0.005, 0.03])
def test_scattered_points_are_found_and_no_others(share: float) -> None:
    rng = np.random.default_rng(1)
    points = sphere(8000, rng)[0]
    stray = scattered(int(share * 8000), rng)
    found = find_outliers(np.vstack([points, stray]))
    assert found[8000:].mean() > 0.97
    assert found[:8000].mean() < 0.001


def test_thinly_scanned_regions_stay() -> None:
    rng = np.random.default_rng(2)
    points = sphere(60_000, rng)[0]
    # Density falls smoothly by a factor of 50 from the top to the bottom, as with distance from a scanner.
    points = points[rng.uniform(size=60_000) < np.exp(-2 * (1 - points[:, 2]))]
    stray = scattered(60, rng)
    found = find_outliers(np.vstack([points, stray]))
    assert found[len(points) :].mean() > 0.85
    assert found[: len(points)].mean() < 0.001


def test_outlier_modes() -> None:
    rng = np.random.default_rng(3)
    points = sphere(8000, rng)[0]
    few = PointCloud(np.vstack([points, scattered(20, rng)]) + UTM)
    many = PointCloud(np.vstack([points, scattered(900, rng)]) + UTM)
    assert clean(few)[1].outliers == pytest.approx(20, abs=1)
    assert clean(few, "on")[1].outliers == clean(few)[1].outliers
    off = clean(few, "off")[1]
    assert (off.outliers, off.outliers_found, off.kept) == (0, clean(few)[1].outliers, 8020)
    auto = clean(many)[1]
    assert (auto.outliers, auto.kept) == (0, 8900)
    assert auto.outliers_found > 445
    assert clean(many, "on")[1].outliers == auto.outliers_found
    assert clean(many, max_outlier_share=0.5)[1].outliers == auto.outliers_found
    assert f"Kept {auto.outliers_found} points that look like outliers." in auto.remarks()


def test_arguments_are_checked() -> None:
    cloud = PointCloud(sphere(20, np.random.default_rng(0))[0])
    with pytest.raises(UsageError, match=r"'maybe' is unknown; expected one of auto, on, off"):
        clean(cloud, "maybe")
    with pytest.raises(UsageError, match=r"1\.5, but must lie in \[0, 1\]"):
        clean(cloud, max_outlier_share=1.5)
