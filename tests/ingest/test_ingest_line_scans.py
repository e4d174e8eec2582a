"""Points along lines: found, thinned, and given normals from the lines on both sides."""

from __future__ import annotations

import numpy as np
import pytest

from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.ingest import prepare
from gnrecon.ingest.line_scans import lie_on_lines, normals_across_lines, thinned_along_lines


def rings(ratio: float, noise: float, radius: float = 0.4, apart: float = 0.15) -> tuple[np.ndarray, np.ndarray]:
    """Return rings around the tube of a torus of radius 1, denser along them by a ratio than they are apart; normals.

    The noise is in distances of points on a ring.
    """
    rng, step = np.random.default_rng(1), apart / ratio
    count, across = int(2 * np.pi * radius / step), int(2 * np.pi / apart)
    v, u = np.meshgrid(np.arange(count) * 2 * np.pi / count, np.arange(across) * 2 * np.pi / across)
    u, v = u.ravel(), (v + 0.2 * step / radius * rng.standard_normal(v.shape)).ravel()
    normals = np.column_stack([np.cos(u) * np.cos(v), np.sin(u) * np.cos(v), np.sin(v)])
    points = radius * normals + np.column_stack([np.cos(u), np.sin(u), 0 * u])
    return points + noise * step * rng.standard_normal(points.shape), normals


@pytest.mark.parametrize(("ratio", "noise"), [(4, 0.0), (6, 0.1), (30, 0.4)])
def test_normals_of_lines_are_those_of_the_surface(ratio: float, noise: float) -> None:
    """Normals of one line are arbitrary: 30 to 100 % of them were off by more than 30 degrees."""
    points, normals = rings(ratio, noise)
    samples, counts = prepare(PointCloud(points + 100))
    assert counts.arrangement == "lines"
    assert counts.along_lines == len(points) - len(samples) > 0.2 * len(points)
    assert any(
        "The points lie along lines" in remark and f"Left out {counts.along_lines} points" in remark
        for remark in counts.remarks()
    )
    kept = samples.frame.to_world(samples.points) - 100
    found = np.linalg.norm(points[:, None] - kept[None, ::7], axis=2).argmin(axis=0)
    cosines = np.einsum("ij,ij->i", samples.normals[::7], normals[found])
    assert (cosines > np.cos(np.radians(30))).mean() >= 0.99


def test_lines_that_bend_more_than_they_are_apart_do_not_count_as_their_own_neighbours() -> None:
    angle, height = np.meshgrid(np.linspace(0, 2 * np.pi, 300, endpoint=False), 1.3 * np.arange(8))
    normals = np.column_stack([np.cos(angle).ravel(), np.sin(angle).ravel(), 0 * angle.ravel()])
    points = normals + np.column_stack([0 * height.ravel(), 0 * height.ravel(), height.ravel() - height.mean()])
    rows, side = thinned_along_lines(points)
    found, known = normals_across_lines(points, rows, side)
    assert known.all()
    assert (np.abs(np.einsum("ij,ij->i", found, normals[rows])) > 0.99).all()


def test_surfaces_and_slightly_uneven_lines_are_no_lines(rng: np.random.Generator) -> None:
    assert not lie_on_lines(rings(2, 0.0)[0])
    assert not lie_on_lines(rng.normal(size=(5, 3)))
    points, normals = rings(2, 0.0)
    samples, counts = prepare(PointCloud(points, normals))
    assert (counts.arrangement, counts.along_lines, len(samples)) == (None, 0, len(points))


def test_good_given_normals_keep_more_points() -> None:
    points, normals = rings(12, 0.0)
    given, estimated = (prepare(PointCloud(points, one))[1] for one in (normals, None))
    assert given.normals == "given"
    assert given.along_lines < 0.4 * len(points) < 0.6 * len(points) < estimated.along_lines


def test_sparse_clouds_whose_winding_number_is_clear_are_not_thinned() -> None:
    angle, height = np.meshgrid(np.linspace(0, 2 * np.pi, 60, endpoint=False), np.linspace(-0.9, 0.9, 7))
    radius = np.sqrt(1 - height**2)
    points = np.column_stack([(radius * np.cos(angle)).ravel(), (radius * np.sin(angle)).ravel(), height.ravel()])
    samples, counts = prepare(PointCloud(points))
    assert (counts.arrangement, counts.half_line_distance, len(samples)) == ("lines", None, len(points))
    assert (np.einsum("ij,ij->i", samples.normals, points) > 0.9).all()


def test_sheets_of_few_points_get_normals_from_the_lines() -> None:
    """Those of all points by their winding number are off by more than 30 degrees at most points of this terrain."""
    y, x = (axis.ravel() for axis in np.meshgrid(np.arange(-1, 1, 0.25), np.arange(-1, 1, 0.25 / 8), indexing="ij"))
    points = np.column_stack([x, y, 0.2 * np.sin(3 * x) + 0.2 * np.cos(4 * y)])
    samples, counts = prepare(PointCloud(points))
    assert counts.arrangement == "lines"
    assert 50 < len(samples) < len(points) / 2
    x, y, _ = samples.frame.to_world(samples.points).T
    truth = np.column_stack([-0.6 * np.cos(3 * x), 0.8 * np.sin(4 * y), np.ones(len(x))])
    assert (np.einsum("ij,ij->i", samples.normals, truth) > 0.85 * np.linalg.norm(truth, axis=1)).all()
