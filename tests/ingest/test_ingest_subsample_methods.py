"""Farthest points, curvature, distances in spacings, and validation points."""

from __future__ import annotations

import made_shapes
import numpy as np
import pytest
from scipy.spatial import cKDTree

from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.ingest import mean_spacing, prepare, subsample
from gnrecon.ingest.subsample import METHODS, farthest_points, pointwise_surface_variation
from gnrecon.runtime.errors import UsageError


def sphere(count: int, rng: np.random.Generator) -> PointCloud:
    points, _ = made_shapes.sphere(count, rng)
    return PointCloud(points, points, {"row": np.arange(count)})


def test_each_farthest_point_is_the_farthest(rng: np.random.Generator) -> None:
    points = sphere(700, rng).points
    chosen = farthest_points(points, 60, rng)
    assert len(set(chosen.tolist())) == 60
    for number in range(1, 60):
        gaps = np.linalg.norm(points[:, None] - points[chosen[:number]], axis=2).min(axis=1)
        assert gaps[chosen[number]] == pytest.approx(gaps.max(), rel=1e-5)


def box_edges(rng: np.random.Generator) -> np.ndarray:
    """A flat sheet with a sharp ridge along x = 0."""
    points = rng.uniform(-1, 1, (8000, 3))
    points[:, 2] = -np.abs(points[:, 0])
    return points


def test_curvature_keeps_more_where_the_surface_bends(rng: np.random.Generator) -> None:
    points = box_edges(rng)
    bend = pointwise_surface_variation(points)
    ridge = np.abs(points[:, 0]) < 0.02
    assert bend[ridge].mean() > 20 * bend[np.abs(points[:, 0]) > 0.2].mean()
    kept = subsample(PointCloud(points), max_points=1000, method="curvature")
    assert len(kept) == 1000
    share = (np.abs(kept.points[:, 0]) < 0.05).mean()
    assert share > 5 * (np.abs(points[:, 0]) < 0.05).mean()
    flat = kept.points[np.abs(kept.points[:, 0]) > 0.2][:, :2]
    assert len(flat) > 300, "flat parts keep their share"


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("count", [1, 10, 499, 500])
def test_counts_are_met_and_the_same_seed_gives_the_same_points(
    method: str, count: int, rng: np.random.Generator
) -> None:
    cloud = sphere(500, rng)
    kept = subsample(cloud, max_points=count, method=method, seed=3)
    assert len(kept) == count
    assert (np.diff(kept.attributes["row"]) > 0).all()
    np.testing.assert_array_equal(subsample(cloud, max_points=count, method=method, seed=3).points, kept.points)


@pytest.mark.parametrize("method", METHODS)
def test_thinning_to_a_distance(method: str, rng: np.random.Generator) -> None:
    cloud = sphere(4000, rng)
    before = mean_spacing(cloud.points)
    kept = subsample(cloud, spacing=3 * before, method=method)
    gaps = cKDTree(kept.points).query(kept.points, 2)[0][:, 1]
    if method == "poisson":
        assert gaps.min() >= 3 * before
        assert cKDTree(kept.points).query(cloud.points)[0].max() < 3 * before, "no other point fits in"
    elif method == "voxel":
        assert len(np.unique(np.floor((kept.points - cloud.points.min(axis=0)) / (3 * before)), axis=0)) == len(kept)
    else:
        assert len(kept) == round(4000 / 9)
    assert np.median(gaps) > 1.3 * before
    assert len(subsample(cloud, spacing=before / 1e3, method=method)) == 4000


def test_spacings_are_those_of_the_whole_cloud(rng: np.random.Generator) -> None:
    cloud = sphere(2000, rng)
    samples, counts = prepare(cloud, spacing="2s", subsample="poisson")
    apart = 2 * mean_spacing(cloud.points) / samples.frame.scale
    assert cKDTree(samples.points).query(samples.points, 2)[0][:, 1].min() >= apart * (1 - 1e-9)
    assert counts.kept == len(samples) == 2000 - counts.thinned
    same, _ = prepare(cloud, spacing="1mm", subsample="voxel", units="cm")
    plain, _ = prepare(cloud, spacing=0.1, subsample="voxel")
    np.testing.assert_array_equal(same.points, plain.points)


def test_points_are_kept_from_the_fit(rng: np.random.Generator) -> None:
    cloud = sphere(1000, rng)
    samples, counts = prepare(cloud, holdout=0.1, fraction=0.5)
    assert samples.held_out is not None
    assert counts.held_out == len(samples.held_out) == 100
    assert counts.kept == len(samples) == 450
    assert counts.thinned == 450
    seen = {tuple(point) for point in np.round(samples.frame.to_world(samples.points), 9)}
    unseen = {tuple(point) for point in np.round(samples.frame.to_world(samples.held_out.points), 9)}
    assert not seen & unseen
    assert unseen <= {tuple(point) for point in np.round(cloud.points, 9)}
    again, _ = prepare(cloud, holdout=0.1, fraction=0.5)
    assert again.held_out is not None
    np.testing.assert_array_equal(again.held_out.points, samples.held_out.points)


@pytest.mark.parametrize("values", [{"holdout": 1.0}, {"holdout": 0.0}, {"spacing": "0s"}, {"spacing": "2 ells"}])
def test_senseless_values(values: dict[str, float | str], rng: np.random.Generator) -> None:
    with pytest.raises(UsageError):
        prepare(sphere(100, rng), **values)  # type: ignore[arg-type]
