"""Several scans become one cloud, by their poses, in bounded memory, whichever way they are cut into chunks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scan_writers import FORMS, file_of, random_cloud

from gnrecon.io import IOParameters, read_cloud, read_scans
from gnrecon.io.contents import Contents
from gnrecon.io.format_registry import CHUNK_READERS
from gnrecon.io.formats.stanford_conf import parse_conf
from gnrecon.io.merge import VoxelThinning
from gnrecon.runtime.errors import InputError

PLY = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\nend_header\n"


def test_scans_of_a_conf_are_turned_by_the_inverse_of_the_common_rotation(tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_text(PLY + "1 0 0\n0 0 1\n")
    half = np.sqrt(0.5)
    lines = "camera 0 0 0 0 0 0 1\nbmesh a.ply 0 0 0 0 0 0 1\n"
    (tmp_path / "a.conf").write_text(lines + f"mesh a.ply 10 0 0 0 0 {half} {half}\nmesh gone.ply 0 0 0 0 0 0 1\n")
    cloud, reading = read_scans([tmp_path / "a.conf"])
    # A quarter turn about z commonly takes x to y; its inverse takes x to -y.
    np.testing.assert_allclose(cloud.points, [[1, 0, 0], [0, 0, 1], [10, -1, 0], [10, 0, 1]], atol=1e-12)
    assert cloud.origins is not None
    assert (cloud.origins[:, 2] > 100).all()
    assert reading.unread == ("the scan gone.ply, which is missing",)
    assert reading.remarks() == ["Not read: the scan gone.ply, which is missing."]


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("bmesh a.ply 0 0 0 0 0 1\n", "does not hold a file, a translation and a quaternion"),
        ("bmesh a.ply 0 0 0 0 0 0 0\n", "does not hold"),
        ("bmesh a.ply 0 0 zero 0 0 0 1\n", "'zero' is not a number"),
        ("camera 0 0 0 0 0 0 1\n", "names no scan"),
        ("mesh none.ply 0 0 0 0 0 0 1\n", "none of the 1 scans"),
    ],
)
def test_damaged_confs(tmp_path: Path, text: str, sentence: str) -> None:
    (tmp_path / "a.conf").write_text(text)
    with pytest.raises(InputError, match=sentence):
        read_cloud(tmp_path / "a.conf")


def test_a_conf_reaches_no_file_outside_of_its_folder(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    (tmp_path / "a.ply").write_text(PLY + "1 0 0\n0 0 1\n")
    (tmp_path / "in" / "a.conf").write_text("mesh ../a.ply 0 0 0 0 0 0 1\n")
    with pytest.raises(InputError, match="outside"):
        read_cloud(tmp_path / "in" / "a.conf")


def test_the_bunny_s_scans_lie_on_each_other(shared_data: Path) -> None:
    from scipy.spatial import cKDTree

    folder = shared_data / "real/bunny_scans"
    poses = {pose.file: pose for pose in parse_conf((folder / "bun.conf").read_text())}
    whole = read_cloud(folder / "bun000.ply").points
    for name in ("bun045.ply", "bun315.ply"):
        points = read_cloud(folder / name).points @ poses[name].rotation.T + poses[name].translation
        gaps = cKDTree(whole).query(points[::20])[0]
        assert np.median(gaps) < 0.0005, "the scans' own spacing"
    cloud, reading = read_scans([folder / "bun.conf"])
    assert len(cloud) == reading.points > 200_000
    assert cloud.origins is not None
    assert len(np.unique(cloud.origins, axis=0)) == 6
    # The scanner sees the side that looks towards it: outward normals of the finished model agree with the origins.
    model = read_cloud(shared_data / "paper/bun_zipper.ply")
    gap, row = cKDTree(model.points).query(cloud.points[::50])
    assert model.normals is not None
    towards = np.einsum("ij,ij->i", model.normals[row], (cloud.origins - cloud.points)[::50])
    assert (towards[gap < 0.001] > 0).mean() > 0.97


def test_several_files_are_merged(rng: np.random.Generator, tmp_path: Path) -> None:
    one, other = random_cloud(rng, 30), random_cloud(rng, 20)
    paths = [file_of("ply", one, tmp_path), file_of("las", other, tmp_path), file_of("ptx", other, tmp_path)]
    cloud, reading = read_scans(paths)
    np.testing.assert_array_equal(cloud.points, np.vstack([one.points, other.points, other.points]))
    assert set(cloud.attributes) == {"colors", "intensity"}
    assert cloud.normals is None
    assert cloud.origins is not None
    assert np.isnan(cloud.origins).all(axis=1).tolist() == [True] * 50 + [False] * 20
    assert reading.points == reading.kept == 70
    assert set(reading.unread) == {
        "normals of some of the scans",
        "row of some of the scans",
        "column of some of the scans",
    }
    with pytest.raises(InputError, match="no such file"):
        read_scans([paths[0], tmp_path / "none.ply"])


@pytest.mark.parametrize("name", ["ply", "xyz", "txt", "csv", "pts", "las", "laz", "ptx", "xyz-gz", "ply-text"])
def test_chunks_make_no_difference(name: str, tmp_path: Path) -> None:
    path = file_of(name, random_cloud(np.random.default_rng(5), 100), tmp_path)
    whole, _ = read_scans([path])
    for rows in (7, 50, 1000):
        cloud, reading = read_scans([path], parameters=IOParameters(chunk_points=rows))
        np.testing.assert_array_equal(cloud.points, whole.points)
        assert (cloud.normals is None) == (whole.normals is None)
        assert cloud.normals is None or np.array_equal(cloud.normals, whole.normals)
        assert cloud.attributes.keys() == whole.attributes.keys()
        for key, values in whole.attributes.items():
            np.testing.assert_array_equal(cloud.attributes[key], values)
        assert reading.side is None
        assert reading.remarks() == []


@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(1, 400),
    most=st.integers(1, 100),
    scale=st.sampled_from([1e-12, 1.0, 1e9, 1e300]),
)
def test_thinning_keeps_the_first_point_of_each_voxel_however_it_is_cut(
    seed: int, count: int, most: int, scale: float
) -> None:
    rng = np.random.default_rng(seed)
    points = scale * rng.uniform(-1, 1, (count, 3))
    points[rng.random(count) < 0.05] = np.nan
    results = []
    for cuts in (np.array([], int), np.sort(rng.integers(0, count, 5)), np.arange(1, count)):
        thinning = VoxelThinning(most)
        for rows in np.split(np.arange(count), cuts):
            thinning.add(Contents(points[rows], attributes={"row": rows}))
        results.append((thinning.result(), thinning.side, thinning.seen))
    first, side, seen = results[0]
    assert seen == count
    if count <= most:
        assert side is None
        np.testing.assert_array_equal(first.attributes["row"], np.arange(count))
    for found, other, _ in results[1:]:
        np.testing.assert_array_equal(found.attributes["row"], first.attributes["row"])
        assert other == side
    if side is None:
        return
    finite = np.flatnonzero(np.isfinite(points).all(axis=1))
    assert len(first.points) <= most
    if len(finite):
        # The slow way: walk through all points, and keep the first one of each cube.
        taken: dict[tuple[float, ...], int] = {}
        for row in finite:
            cube = np.floor(points[row] / side - points[finite[0]] / side)
            taken.setdefault(tuple(cube), row)
        assert first.attributes["row"].tolist() == list(taken.values())


def test_more_points_than_are_to_be_kept(rng: np.random.Generator, tmp_path: Path) -> None:
    path = file_of("ply", random_cloud(rng, 500), tmp_path)
    cloud, reading = read_scans([path], most=100)
    assert 10 < len(cloud) <= 100
    assert cloud.normals is not None
    assert len(cloud.attributes["colors"]) == len(cloud)
    assert reading.points == 500
    assert reading.side is not None
    assert reading.remarks()[0].startswith(f"Kept {len(cloud)} of 500 points, the first one in each cube of side ")


def test_large_files_that_are_damaged(tmp_path: Path) -> None:
    parameters = IOParameters(chunk_points=8)
    for name in ("ply", "xyz", "las", "laz", "ptx"):
        path = file_of(name, random_cloud(np.random.default_rng(1), 50), tmp_path)
        path.write_bytes(path.read_bytes()[:-300] + b"\n0 0 a\n")
        with pytest.raises(InputError, match=f"^{path}: "):
            read_scans([path], parameters=parameters)


def test_every_chunked_format_is_tried_here() -> None:
    chunked = set(CHUNK_READERS)
    assert chunked
    assert chunked <= {form.suffix for form in FORMS.values()}
