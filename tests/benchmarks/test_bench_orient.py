"""The benchmark of orientation: its truths are right, its sums plain, and its tables hold what was measured."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from benchmarks.accuracy.cases import cases_of
from benchmarks.accuracy.comparison import Protocol
from benchmarks.accuracy.orientation import ORIENTATION_GROUPS, main, meshes_table, sides, true_normals
from benchmarks.accuracy.problem import Problem
from benchmarks.accuracy.scans import AnalyticScan

from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.runtime.errors import ExitCode, UsageError

NOWHERE = Path("nowhere")
CASES = cases_of(ORIENTATION_GROUPS)


def test_true_normals_are_the_scans_or_the_surfaces() -> None:
    problem = AnalyticScan("torus", 500).problem(NOWHERE, 0)
    given = problem.scan.normals
    unoriented = Problem(problem.scan.with_normals(None), problem.truth)
    assert np.allclose(true_normals(problem), given)
    found = true_normals(unoriented)
    assert np.einsum("ij,ij->i", found, given).min() > 0.999
    cloud = PointCloud(unoriented.scan.points)
    assert true_normals(Problem(cloud, cloud)) is None
    assert sides(Problem(cloud, cloud))["gnrecon"]["right"] is None


def test_sides_are_counted() -> None:
    figures = sides(CASES["torus, 400 points"].problem(NOWHERE, 0))
    assert figures["gnrecon"]["right"] == 1
    assert figures["gnrecon"]["angle_mean"] < 5
    assert figures["confidence"] > 0.9
    assert 0.5 <= figures["open3d"]["right"] <= 1


@pytest.mark.parametrize("name", [name for name in CASES if "points" in name])
def test_sparse_thin_and_sharp_clouds_are_oriented(name: str) -> None:
    figures = sides(CASES[name].problem(NOWHERE, 0))
    assert figures["gnrecon"]["right"] >= (0.97 if name == "plate, 500 points" else 0.99)


def test_files_without_normals_are_oriented_as_their_truths(shared_data: Path) -> None:
    for name in ("kitten", "mug"):
        assert sides(CASES[name].problem(shared_data, 0))["gnrecon"]["right"] >= 0.99


@pytest.mark.usefixtures("measured_here")
def test_the_benchmark_writes_and_prints(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    report = tmp_path / "orient.json"
    tiny = Protocol(threads=1, samples=2000, depths=(5,), options={"resolution": 24, "widths": (300,), "steps": 0})
    words = ["--cases", "torus, 400 points", "--fits", "--json", str(report)]
    assert main(words, tiny) == ExitCode.OK
    (found,) = json.loads(report.read_text())["cases"]
    meshes = found["meshes"]
    assert set(meshes) == {"gnrecon", "Poisson", "given"}
    assert 0 < meshes["gnrecon"]["chamfer_mean"] < 0.05
    assert "folder" not in meshes["gnrecon"]
    out = capsys.readouterr().out
    assert "100.00%" in out
    assert f"{1e3 * meshes['given']['chamfer_mean']:.3f}" in out


def test_failures_have_no_figures() -> None:
    case = {"case": "a", "unit": "1", "factor": 1.0, "meshes": {"gnrecon": {"error": "No."}, "Poisson": {}}}
    assert meshes_table([case]).row_count == 1


def test_unknown_cases_are_refused() -> None:
    with pytest.raises(UsageError, match="no case 'teapot'"):
        main(["--cases", "teapot"])
