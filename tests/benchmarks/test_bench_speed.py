"""The benchmark of whole commands: both methods run, and the exponent is that of the times."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from benchmarks.speed import Surface, exponent
from benchmarks.speed import main as speed

from gnrecon.geometry.mesh import Mesh
from gnrecon.io import write_mesh
from gnrecon.runtime.errors import ExitCode, InputError, OutputError, UsageError


def test_both_commands_are_timed_and_measured(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    report, picture = tmp_path / "speed.json", tmp_path / "speed.png"
    words = ["--counts", "300", "--repeat", "1", "--depth", "4", "--json", str(report), "--picture", str(picture)]
    assert speed([*words, "--", "--quality", "draft", "--resolution", "24"]) == ExitCode.OK
    found = json.loads(report.read_text())
    methods = found["scans"][0]["methods"]
    for one in methods.values():
        assert 0 < one["mean"] < one["largest"]
        assert one["seconds"] == one["runs"][0]["seconds"] > 0.1
        assert one["cpu_seconds"] > 0.1
        assert one["peak_memory_mb"] > 100
    assert methods["gnrecon"]["mean"] < methods["Poisson"]["mean"]
    assert found["exponents"] == {"gnrecon": None, "Poisson": None}
    assert 0 < found["version"]["seconds"] < found["scans"][0]["methods"]["gnrecon"]["seconds"]
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert "mean distance" in capsys.readouterr().out


def test_a_mesh_is_scanned_in_place_of_the_ball(tmp_path: Path) -> None:
    mesh, report = tmp_path / "shape.obj", tmp_path / "speed.json"
    box = trimesh.creation.icosphere(subdivisions=3, radius=7.0)
    write_mesh(Mesh(np.asarray(box.vertices), np.asarray(box.faces)), mesh)
    words = ["--counts", "400", "--repeat", "1", "--depth", "4", "--surface", str(mesh), "--json", str(report)]
    assert speed([*words, "--", "--quality", "draft", "--resolution", "24"]) == ExitCode.OK
    one = json.loads(report.read_text())["scans"][0]["methods"]["gnrecon"]
    # In spacings: of a ball of 400 unit squares.
    assert 1e-4 < one["mean"] < one["largest"] < 1.0
    with pytest.raises(InputError, match=r"none\.obj"):
        speed(["--counts", "400", "--surface", str(tmp_path / "none.obj")])


def test_the_scan_of_a_mesh_has_one_point_for_each_square_unit() -> None:
    box = trimesh.creation.box((3.0, 1.0, 2.0))
    truth = Surface.of(Mesh(np.asarray(box.vertices), np.asarray(box.faces)), 2200)
    cloud = truth.scan()
    assert len(cloud.points) == 2200
    assert cloud.normals is not None
    np.testing.assert_allclose(truth.distances(cloud.points + 0.5 * cloud.normals), 0.5, atol=1e-9)
    # Of 22 square units, now 2,200.
    np.testing.assert_allclose(np.ptp(truth.mesh.vertices, axis=0), [30.0, 10.0, 20.0])
    assert len(truth.scan(seed=2, noisy=False, count=50).points) == 50


def test_a_command_that_fails_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    report = tmp_path / "speed.json"
    words = ["--counts", "100", "--repeat", "1", "--depth", "3", "--json", str(report), "--", "--resolution", "1"]
    assert speed(words) == ExitCode.BATCH
    methods = json.loads(report.read_text())["scans"][0]["methods"]
    assert "resolution" in methods["gnrecon"]["error"]
    assert "error" not in methods["Poisson"]
    assert "failed" in capsys.readouterr().out


def test_the_exponent_is_that_of_the_times() -> None:
    def scan(points: int, seconds: float) -> dict[str, Any]:
        return {"points": points, "methods": {"one": {"cpu_seconds": seconds}}}

    scans = [scan(1000, 50.0), *(scan(count, 1e-3 * count**1.1) for count in (10_000, 100_000, 1_000_000))]
    assert exponent(scans, "one") == pytest.approx(1.1)
    failed: dict[str, Any] = {"points": 10**7, "methods": {"one": {"error": "no"}}}
    assert exponent([*scans, failed], "one") == pytest.approx(1.1)
    assert exponent(scans[:2], "one") is None


def test_senseless_arguments_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="at least 100 points"):
        speed(["--counts", "10"])
    with pytest.raises(OutputError, match="folder does not exist"):
        speed(["--json", str(tmp_path / "none" / "a.json")])
