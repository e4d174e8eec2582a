"""The benchmark of reading at a small scale: every point is counted, in each format, and thinning keeps what it may."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from benchmarks.streamed_reading import WRITERS
from benchmarks.streamed_reading import main as ingest

from gnrecon.io import read_cloud
from gnrecon.runtime.errors import ExitCode, OutputError, UsageError


def test_every_format_holds_the_same_points(tmp_path: Path) -> None:
    clouds = {}
    for name, write in WRITERS.items():
        write(tmp_path / f"a.{name}", 50)
        clouds[name] = read_cloud(tmp_path / f"a.{name}").points
    for points in clouds.values():
        assert points == pytest.approx(clouds["ply"], abs=1e-8, rel=0)


def test_the_benchmark_measures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    report = tmp_path / "ingest.json"
    words = ["--points", "3000", "--keep", "1000", "--formats", "laz", "--json", str(report)]
    assert ingest(words) == ExitCode.OK
    (figures,) = json.loads(report.read_text())["scans"]
    assert figures["points"] == 3000
    assert 200 < figures["kept"] <= 1000
    assert figures["peak_memory_mb"] > 50
    assert "peak memory, MB" in capsys.readouterr().out


def test_senseless_arguments_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="must be positive"):
        ingest(["--points", "0"])
    with pytest.raises(OutputError, match="folder does not exist"):
        ingest(["--json", str(tmp_path / "none" / "a.json")])
