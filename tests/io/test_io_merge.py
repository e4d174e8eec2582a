"""Files that hold the same scan are named, wherever they put it; other scans are not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from made_shapes import sphere
from scan_files import torus, write_scan
from scipy.spatial.transform import Rotation

from gnrecon.geometry.moments import Moments
from gnrecon.io import read_scans


def moments(*chunks: np.ndarray) -> Moments:
    found = Moments()
    for chunk in chunks:
        found.add(chunk)
    return found


def test_moments_do_not_change_when_a_scan_moves(rng: np.random.Generator) -> None:
    points = rng.normal(size=(500, 3)) * [3, 2, 1]
    expected = np.linalg.eigvalsh(np.cov(points.T, bias=True))
    broken = np.vstack([[[np.nan, 0, 0]], points[:200]])
    far = np.add(Rotation.random(rng=rng).apply(points), [4e5, 5e6, 100])
    for found in (moments(points), moments(broken, points[200:]), moments(far[:1], far[1:])):
        assert found.count == 500
        np.testing.assert_allclose(found.principal(), expected, rtol=1e-6)
    assert moments(points).same_as(moments(far.astype(np.float32) - np.float32(4e5))) is False
    assert moments(points).same_as(moments(rng.permutation(points).astype(np.float32)))
    assert not moments(points).same_as(moments(points[:-1]))
    assert not moments(points).same_as(moments(rng.normal(size=(500, 3)) * [3, 2, 1]))
    assert not moments(points[:9]).same_as(moments(points[:9]))
    assert np.isnan(moments(np.array([[0.0, 0, 0], [1e300, 0, 0]])).principal()).all()
    assert moments().principal().tolist() == [0, 0, 0]


@pytest.mark.parametrize("moved", [0.0, 0.3])
def test_a_scan_given_twice_is_named(moved: float, tmp_path: Path, rng: np.random.Generator) -> None:
    points, normals = torus(400, rng)
    first = write_scan(tmp_path / "a.ply", points, normals)
    other = write_scan(tmp_path / "b.ply", *sphere(400, rng))
    again = write_scan(tmp_path / "c.ply", Rotation.from_euler("x", moved).apply(points) + moved, normals)
    reading = read_scans([first, other, again])[1]
    assert reading.same == ((str(first), str(again)),)
    assert f"{again} seems to be the same scan as {first}" in reading.remarks()[0]
    assert read_scans([first, other])[1].same == ()
