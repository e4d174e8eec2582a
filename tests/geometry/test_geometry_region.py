"""Boxes and clipping planes select points in memory, while files are read, and on the command line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_shapes import sphere
from scan_files import gnrecon, write_scan

from gnrecon.batch.request import Request
from gnrecon.cli.app import main
from gnrecon.geometry.point_cloud import PointCloud, Region
from gnrecon.geometry.units import parse_plane
from gnrecon.io import cropped, read_scans
from gnrecon.io.contents import Contents
from gnrecon.io.merge import VoxelThinning
from gnrecon.options import Options
from gnrecon.runtime.errors import UsageError

BOX = ((-1.0, -1.0, 0.0), (1.0, 1.0, 1.0))
NUMBERS = st.sampled_from([-2.0, -1.0, -0.5, 0.0, 0.5, 1.0, 2.0])
POINT = st.tuples(NUMBERS, NUMBERS, NUMBERS)


def wanted(point: tuple[float, ...], region: Region) -> bool:
    """One point at a time, one comparison at a time."""
    within = [
        all(low <= x <= high for low, x, high in zip(lower, point, upper, strict=True)) for lower, upper in region.boxes
    ]
    sides = [a * point[0] + b * point[1] + c * point[2] + d >= 0 for a, b, c, d in region.planes]
    return (any(within) or not region.boxes) and all(sides)


@given(
    points=st.lists(POINT, min_size=1, max_size=8),
    boxes=st.lists(st.tuples(POINT, POINT), max_size=2),
    planes=st.lists(st.tuples(NUMBERS, NUMBERS, NUMBERS, NUMBERS), max_size=2),
)
def test_a_region_holds_what_it_says(points: list[Any], boxes: list[Any], planes: list[Any]) -> None:
    region = Region(tuple(boxes), tuple(planes))
    assert region.holds(np.array(points)).tolist() == [wanted(point, region) for point in points]


def test_a_point_that_is_not_finite_is_left_to_be_counted_as_that() -> None:
    points = np.array([[np.nan, 0, 0], [np.inf, 0, 0], [5, 5, 5], [0, 0, 0.5]])
    assert Region((BOX,), ((0, 0, 1, 0),)).holds(points).tolist() == [True, True, False, True]
    assert Region().everything
    assert not Region((BOX,)).everything
    assert not Region((), ((0, 0, 1, 0),)).everything


def test_cropping_is_counted_and_attributes_follow() -> None:
    points = sphere(500, np.random.default_rng(0))[0]
    inside, reading = cropped(PointCloud(points, points, {"label": np.arange(500)}), Region((BOX,)))
    above = np.flatnonzero(points[:, 2] >= 0)
    np.testing.assert_array_equal(inside.attributes["label"], above)
    np.testing.assert_array_equal(inside.normals, points[above])
    assert (reading.points, reading.kept, reading.cropped) == (500, len(above), 500 - len(above))
    assert reading.remarks() == [f"Dropped {500 - len(above)} of 500 points outside of the region."]
    with pytest.raises(UsageError, match="None of the 500 points lies in the region; gnrecon info prints"):
        cropped(PointCloud(points + 9), Region((BOX,)))


@pytest.mark.parametrize("most", [100, 10_000])
def test_large_scans_are_thinned_to_what_is_wanted_of_them(most: int) -> None:
    points = sphere(4000, np.random.default_rng(0))[0]
    small = points[:, 2] >= 0.95
    thinning = VoxelThinning(most, Region((((-1, -1, 0.95), (1, 1, 1)),)))
    for start in range(0, 4000, 300):
        thinning.add(Contents(points[start : start + 300]))
    found = thinning.result().points
    assert (thinning.seen, thinning.cropped) == (4000, 4000 - small.sum())
    assert 45 < small.sum() < 150
    if small.sum() <= most:
        assert thinning.side is None
        np.testing.assert_array_equal(found, points[small])


def test_the_command_line_crops(tmp_path: Path) -> None:
    points, normals = sphere(1500, np.random.default_rng(0))
    scan = write_scan(tmp_path / "ball.ply", points + 100, normals)
    words = ("--crop", "99.5,99,99,102,102,102", "--clip-plane", "-1,0,0,100.75", "--clip-plane", "0,1,0,-99.2")
    fast = ("--widths", "200", "--steps", "0", "--resolution", "24", "--report", tmp_path / "report.json")
    done = gnrecon(scan, "-o", tmp_path / "mesh.ply", *words, *fast)
    assert done.returncode == 0, done.stderr
    kept = (points[:, 0] >= -0.5) & (points[:, 0] <= 0.75) & (points[:, 1] >= -0.8)
    reading = json.loads((tmp_path / "report.json").read_text())["reading"]
    assert (reading["points"], reading["kept"], reading["cropped"]) == (1500, kept.sum(), 1500 - kept.sum())
    assert f"Dropped {1500 - kept.sum():,} of 1,500 points outside of the region." in done.stderr
    cloud, _ = read_scans([scan], region=Options(crop="99.5,99,99,102,102,102").region())
    np.testing.assert_array_equal(cloud.points, (points + 100)[points[:, 0] >= -0.5])


def test_a_batch_passes_boxes_and_planes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    requests: list[Request] = []
    monkeypatch.setattr("gnrecon.batch.runner.run_batch", lambda request: requests.append(request) or 0)
    boxes = ("--crop", "-1,-1,-1,1,1,1", "--crop", "2,2,2,3,3,3", "--clip-plane", "-1,0,0,2")
    with pytest.raises(SystemExit) as ended:
        main(["batch", str(tmp_path), "-o", str(tmp_path), *boxes, "--smooth-scan", "8s", "--clusters", "off"])
    assert ended.value.code == 0
    passed = requests[0].settings.of(tmp_path / "scan.ply")
    assert list(passed["crop"]) == ["-1,-1,-1,1,1,1", "2,2,2,3,3,3"]
    assert list(passed["clip_plane"]) == ["-1,0,0,2"]
    assert (passed["smooth_scan"], passed["clusters"]) == ("8s", "off")


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        ({"crop": "1,2,3"}, "is not a box: six numbers"),
        ({"crop": ["0,0,0,1,1,1", "1,0,0,0,1,1"]}, "its lower corner must come first"),
        ({"clip_plane": "1,0,0"}, "is not a plane: four numbers a,b,c,d"),
        ({"clip_plane": ("0,0,0,1",)}, "its numbers must be finite, and a,b,c not all zero"),
        ({"clip_plane": ("1,0,0,nan",)}, "its numbers must be finite, and a,b,c not all zero"),
    ],
)
def test_texts_that_are_no_region_are_refused(values: dict[str, Any], sentence: str) -> None:
    with pytest.raises(UsageError, match=sentence):
        Options.of(**values)


def test_a_plane_is_four_numbers() -> None:
    assert parse_plane("1, -2,3e1,.5") == (1.0, -2.0, 30.0, 0.5)
    assert Options(clip_plane="1,0,0,2").region() == Region((), ((1.0, 0.0, 0.0, 2.0),))
