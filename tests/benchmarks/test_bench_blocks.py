"""The benchmark of large scans at a small scale: its truth is exact, and its figures are those of a real run."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from benchmarks.scaling import main as blocks
from benchmarks.scaling_run import Ball

from gnrecon.runtime.errors import ExitCode, OutputError, UsageError


def test_exact_points_lie_on_the_surface_with_its_normals() -> None:
    ball = Ball(20_000)
    cloud = ball.scan(noisy=False, count=500)
    assert cloud.normals is not None
    assert np.abs(ball.distances(cloud.points)).max() < 1e-9
    # A short step along the normal goes as far from the surface as it is long.
    assert ball.distances(cloud.points + 1e-3 * cloud.normals) == pytest.approx(1e-3, rel=1e-2)
    assert np.ptp(np.linalg.norm(cloud.points, axis=1)) > 1.0


def test_noise_is_as_large_as_it_says() -> None:
    ball = Ball(20_000)
    assert ball.distances(ball.scan(count=5000).points).std() == pytest.approx(0.1, rel=0.1)


@pytest.mark.usefixtures("measured_here")
def test_the_benchmark_measures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    report, picture = tmp_path / "blocks.json", tmp_path / "blocks.png"
    words = ["--counts", "1000", "--quality", "draft", "--resolution", "24"]
    assert blocks([*words, "--json", str(report), "--picture", str(picture)]) == ExitCode.OK
    whole, run = json.loads(report.read_text())["runs"]
    assert (whole["blocks"], run["blocks"]) == (False, True)
    assert whole["missed"] != run["missed"]
    for one in (whole, run):
        assert one["jump"]["value"] < 1e-5
        assert one["to_truth"]["mean"] < 1.0
        assert one["missed"] < 0.2
        assert one["memory_mb"]["together"] >= one["memory_mb"]["own"] > 200
        assert one["guarantee"] == "closed, oriented 2-manifold"
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert "processor seconds for 100,000 points" in capsys.readouterr().out


def test_senseless_arguments_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"at least 1,000 points"):
        blocks(["--counts", "10"])
    with pytest.raises(OutputError, match="folder does not exist"):
        blocks(["--json", str(tmp_path / "none" / "a.json")])
