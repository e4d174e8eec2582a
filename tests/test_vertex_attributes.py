"""Whole reconstructions carry what their scans hold, and the distance to them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scan_files import TUBE, torus

from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.io import read_mesh
from gnrecon.pipeline import Progress, Reconstruction, reconstruct
from gnrecon.runtime.errors import FitError, UsageError
from gnrecon.vertex_attributes import requested_names

FAST = {"widths": (300,), "steps": 0, "resolution": 32}


class Recorder(Progress):
    """Remembers stages and remarks."""

    def __init__(self) -> None:
        self.stages: list[str] = []
        self.remarks: list[str] = []

    def stage(self, name: str) -> None:
        self.stages.append(name)

    def remark(self, sentence: str) -> None:
        self.remarks.append(sentence)


@pytest.fixture(scope="module")
def scan() -> PointCloud:
    """A torus of two halves, red and blue, at another height each."""
    points, normals = torus(1200, np.random.default_rng(5))
    red = points[:, :1] > 0
    colors = np.where(red, [200, 0, 0], [0, 0, 200]).astype(np.uint8)
    return PointCloud(points, normals, {"colors": colors, "height": points[:, 2], "half": red[:, 0].astype(np.int16)})


@pytest.fixture(scope="module")
def result(scan: PointCloud) -> Reconstruction:
    return reconstruct(scan, **FAST)


def test_a_mesh_looks_like_its_scan(scan: PointCloud, result: Reconstruction) -> None:
    vertices, found = result.mesh.vertices, result.mesh.attributes
    clear = np.abs(vertices[:, 0]) > 0.25
    right = vertices[:, 0] > 0
    expected = np.where(right[:, None], [200, 0, 0], [0, 0, 200])
    assert np.array_equal(found["colors"][clear], expected[clear])
    assert np.array_equal(found["half"][clear], right[clear].astype(np.int16))
    assert np.abs(found["height"] - vertices[:, 2]).max() < 0.15
    away = np.linalg.norm(vertices[:, None] - scan.points, axis=2).min(axis=1)
    np.testing.assert_allclose(found["distance"], away, atol=1e-12)


def test_the_report_says_how_each_was_made(result: Reconstruction) -> None:
    listed = json.loads(json.dumps(result.report["attributes"]))
    assert [one["name"] for one in listed] == ["distance", "colors", "height", "half"] == list(result.mesh.attributes)
    assert listed[1]["origin"] == "weighted mean in linear light of the 8 nearest points"
    assert listed[3]["origin"].startswith("greatest weight")


@pytest.mark.parametrize(
    ("asked", "given"), [("none", []), ("height", ["height"]), ("half, distance", ["distance", "half"])]
)
def test_only_what_is_asked_for(scan: PointCloud, asked: str, given: list[str]) -> None:
    mesh = reconstruct(scan, attributes=asked, **FAST).mesh
    assert list(mesh.attributes) == given


def test_a_misspelt_name_is_refused_before_the_fit(scan: PointCloud) -> None:
    told = Recorder()
    with pytest.raises(UsageError, match=r"no attribute 'colour'.*has distance, colors, height, half"):
        reconstruct(scan, attributes="colour", progress=told)
    assert told.stages == ["read"]
    with pytest.raises(UsageError, match="names separated by commas, not 'a,,b'"):
        reconstruct(scan, attributes="a,,b")


def test_a_scan_with_distances_of_its_own_is_told_that_they_give_way(scan: PointCloud) -> None:
    told = Recorder()
    own: dict[str, Any] = {"distance": np.full(len(scan), 9.0)}
    mesh = reconstruct(PointCloud(scan.points, scan.normals, own), progress=told, **FAST).mesh
    assert mesh.attributes["distance"].max() < 1
    assert "The points' attribute 'distance' is replaced by the distance to the points." in told.remarks
    assert requested_names(PointCloud(scan.points, None, own), "auto") == ["distance"]


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".glb", ".3mf", ".off", ".stl"])
def test_what_was_carried_is_in_the_file_or_said_to_be_lost(
    result: Reconstruction, tmp_path: Path, suffix: str
) -> None:
    (tmp_path / "out").mkdir()
    sentences = result.save(tmp_path / "out" / f"mesh{suffix}")
    found = read_mesh(tmp_path / "out" / f"mesh{suffix}").attributes
    carried = {"colors", "height", "half"}
    lost = {".ply": set(), ".glb": set(), ".stl": carried}.get(suffix, carried - {"colors"})
    # Nobody asked for the distance, so nobody is told where it is left out.
    assert set(found) == carried - lost | ({"distance"} if not lost else set())
    assert len(sentences) == bool(lost)
    assert all(name in sentences[0] and "distance" not in sentences[0] for name in lost)
    if "colors" in found:
        assert np.array_equal(found["colors"][:, :3], result.mesh.attributes["colors"])


def test_distances_that_were_asked_for_are_missed(scan: PointCloud, tmp_path: Path) -> None:
    sentences = reconstruct(scan, attributes="distance", **FAST).save(tmp_path / "mesh.obj")
    assert sentences == ["OBJ cannot hold distance of the vertices; PLY can."]


def test_curvature_of_a_torus(scan: PointCloud) -> None:
    plain = PointCloud(scan.points, scan.normals)
    result = reconstruct(plain, curvature=True, widths=(600,), steps=1, resolution=48)
    found = result.mesh.attributes
    assert list(found) == ["distance", "mean_curvature", "gauss_curvature"]
    assert "per squared file unit" in result.report["attributes"][2]["origin"]
    cosine = (np.hypot(*result.mesh.vertices[:, :2].T) - 1) / TUBE
    out = 1 + TUBE * cosine
    mean, gauss = (1 + 2 * TUBE * cosine) / (2 * TUBE * out), cosine / (TUBE * out)
    assert np.median(np.abs(found["mean_curvature"] - mean)) < 0.05
    assert np.median(np.abs(found["gauss_curvature"] - gauss)) < 0.15
    assert np.corrcoef(found["gauss_curvature"], gauss)[0, 1] > 0.95


@pytest.fixture(scope="module")
def doubtful(scan: PointCloud) -> Reconstruction:
    """With an attribute of the points that has the name of the surface's standard deviation."""
    own = PointCloud(scan.points, scan.normals, {"sigma": scan.points[:, 2]})
    told = Recorder()
    found = reconstruct(own, progress=told, uncertainty=True, **FAST)
    assert "The points' attribute 'sigma' is replaced by the standard deviation of the surface." in told.remarks
    return found


def test_sigma_is_there_when_asked_for(result: Reconstruction, doubtful: Reconstruction) -> None:
    assert "sigma" not in result.mesh.attributes
    assert result.uncertainty is None
    assert doubtful.uncertainty is not None
    exact = doubtful.uncertainty.sigma(doubtful.mesh.vertices)
    np.testing.assert_array_equal(doubtful.mesh.attributes["sigma"], exact)
    assert (exact > 0).all()
    (origin,) = [one["origin"] for one in doubtful.report["attributes"] if one["name"] == "sigma"]
    assert doubtful.uncertainty.describe() in origin


def test_a_sigma_that_cannot_be_had_is_a_sentence(scan: PointCloud, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> None:
        raise FitError("No factor.")

    monkeypatch.setattr("gnrecon.vertex_attributes.Uncertainty.of", refuse)
    told = Recorder()
    found = reconstruct(scan, progress=told, uncertainty=True, **FAST)
    assert "sigma" not in found.mesh.attributes
    assert any(remark.startswith("There is no sigma") for remark in told.remarks)


def test_places_in_a_grid_are_carried_only_when_asked_for(scan: PointCloud) -> None:
    gridded = PointCloud(scan.points, scan.normals, {"row": np.arange(len(scan)), "intensity": scan.points[:, 0]})
    assert requested_names(gridded, "auto") == ["distance", "intensity"]
    assert requested_names(gridded, "row") == ["row"]
