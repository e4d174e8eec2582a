"""Thinning keeps the requested number of real points, reproducibly; and the two even methods are even."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_shapes import sphere
from scipy.spatial import cKDTree

from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.ingest import mean_spacing, subsample
from gnrecon.ingest.subsample import METHODS
from gnrecon.runtime.errors import UsageError

UTM = np.array([431234.123456789, 5412345.987654321, 312.1])


def cloud_of(count: int, seed: int, offset: np.ndarray | float = 0.0) -> PointCloud:
    points, normals = sphere(count, np.random.default_rng(seed))
    return PointCloud(points + offset, normals, {"row": np.arange(count)})


@pytest.mark.parametrize("method", sorted(METHODS))
@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 1000),
    size=st.integers(2, 400),
    fraction=st.floats(0.001, 1),
    bound=st.none() | st.integers(1, 500),
    offset=st.sampled_from([0.0, UTM]),
)
def test_counts_rows_and_determinism(
    method: str, seed: int, size: int, fraction: float, bound: int | None, offset: float
) -> None:
    cloud = cloud_of(size, seed, offset)
    thinned = subsample(cloud, fraction=fraction, max_points=bound, method=method, seed=seed)
    expected = max(1, round(fraction * size))
    assert len(thinned) == (expected if bound is None else min(expected, bound))
    rows = thinned.attributes["row"]
    assert (np.diff(rows) > 0).all()
    np.testing.assert_array_equal(thinned.points, cloud.points[rows])
    assert thinned.normals is not None
    assert cloud.normals is not None
    np.testing.assert_array_equal(thinned.normals, cloud.normals[rows])
    again = subsample(cloud, fraction=fraction, max_points=bound, method=method, seed=seed)
    np.testing.assert_array_equal(again.attributes["row"], rows)


@pytest.mark.parametrize("method", sorted(METHODS))
def test_seeds_differ(method: str) -> None:
    cloud = cloud_of(2000, 0)
    first, second = (subsample(cloud, max_points=300, method=method, seed=seed) for seed in (0, 1))
    assert not np.array_equal(first.attributes["row"], second.attributes["row"])


def unevenness(points: np.ndarray) -> float:
    distances = cKDTree(points).query(points, 2)[0][:, 1]
    return float(distances.std() / distances.mean())


def test_even_methods_are_even_where_the_scan_is_not() -> None:
    rng = np.random.default_rng(0)
    points = sphere(40_000, rng)[0]
    cloud = PointCloud(points[rng.uniform(size=40_000) < np.exp(-0.7 * (1 - points[:, 2]))])
    by_method = {method: subsample(cloud, max_points=700, method=method).points for method in METHODS}
    assert unevenness(by_method["poisson"]) < 0.15 < unevenness(by_method["voxel"]) < 0.4
    assert unevenness(by_method["random"]) > 0.45
    upper = {method: (points[:, 2] > 0).mean() for method, points in by_method.items()}
    assert upper["poisson"] == pytest.approx(0.5, abs=0.05)
    assert upper["voxel"] == pytest.approx(0.5, abs=0.05)
    assert upper["random"] > 0.63


def test_nothing_to_leave_out_gives_the_same_cloud() -> None:
    cloud = cloud_of(50, 0)
    assert subsample(cloud) is cloud
    assert subsample(cloud, max_points=50, method="voxel") is cloud
    assert subsample(cloud, fraction=1.0, method="poisson") is cloud


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"fraction": 0.0}, r"fraction of points is 0\.0, but must lie in \(0, 1\]"),
        ({"fraction": 1.01}, r"1\.01"),
        ({"fraction": float("nan")}, "nan"),
        ({"max_points": 0}, "is 0, but must be at least 1"),
        ({"method": "magic"}, "'magic' is unknown; expected one of random, voxel, poisson"),
    ],
)
def test_arguments_are_checked(options: dict[str, object], sentence: str) -> None:
    with pytest.raises(UsageError, match=sentence):
        subsample(cloud_of(20, 0), **options)  # type: ignore[arg-type]


@pytest.mark.parametrize("offset", [0.0, UTM])
def test_spacing_of_a_grid_is_its_step(offset: float) -> None:
    grid = np.stack(np.meshgrid(*[np.arange(30) * 0.25] * 3), axis=-1).reshape(-1, 3)
    assert mean_spacing(grid + offset) == pytest.approx(0.25, abs=1e-9)
