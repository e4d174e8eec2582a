"""The benchmark of scans that people have: its distances, its scans of lines, and its report."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from benchmarks.inputs import both_ways, main, rings, stored_case, torus

from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.ingest.line_scans import lie_on_lines
from gnrecon.io import write_cloud
from gnrecon.runtime.errors import ExitCode


def test_distances_are_means_both_ways(rng: np.random.Generator) -> None:
    ball = trimesh.creation.icosphere(3)
    mesh = Mesh(ball.vertices + np.array([5, 0, 0]), np.asarray(ball.faces))
    directions = rng.normal(size=(5_000, 3))
    points = 1.1 * directions / np.linalg.norm(directions, axis=1, keepdims=True) + [5, 0, 0]
    assert both_ways(mesh, points) == pytest.approx(0.1, abs=0.02)


def test_rings_are_lines_on_a_torus() -> None:
    points = rings(8)
    assert np.allclose(np.hypot(np.hypot(points[:, 0], points[:, 1]) - 1, points[:, 2]), 0.4)
    assert lie_on_lines(points)


def test_the_benchmark_writes_and_prints(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    points, normals = torus(300, np.random.default_rng(0))
    (tmp_path / "01_torus").mkdir()
    write_cloud(PointCloud(points, normals), tmp_path / "01_torus" / "scan.ply")
    assert np.allclose(stored_case(tmp_path / "01_torus").cloud.points, points)
    report = tmp_path / "inputs.json"
    words = ["--data", str(tmp_path), "--cases", "01", "--quality", "draft", "--json", str(report)]
    assert main(words, resolution=24) == ExitCode.OK
    (found,) = json.loads(report.read_text())["cases"]
    assert (found["case"], found["points"], found["normals"]) == ("01_torus", 300, "given")
    assert (found["gnrecon"]["genus"], found["gnrecon"]["parts"]) == (1, 1)
    # The scan is its own truth here: its points on a mesh of 24 cells are far closer than the mesh's to points.
    assert 0 < found["gnrecon"]["distance"] < 0.1
    assert 0 < found["Poisson"]["distance"] < 0.2
    assert "01_torus" in capsys.readouterr().out
