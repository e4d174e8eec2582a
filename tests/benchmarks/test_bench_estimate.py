"""The benchmark of estimates: runs are compared with what was expected of them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from benchmarks.estimates import main as estimates
from benchmarks.estimates import spread

from gnrecon.runtime.errors import ExitCode, UsageError

FEW = ["--counts", "300", "--scans", "--qualities", "draft", "--resolutions", "32"]


def test_runs_are_compared_with_what_was_expected(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    report = tmp_path / "estimate.json"
    assert estimates([*FEW, "--json", str(report)]) == ExitCode.OK
    usual, coarse = json.loads(report.read_text())["runs"]
    assert coarse["options"] == {"quality": "draft", "resolution": 32}
    assert coarse["faces"] < usual["faces"]
    for one in (usual, coarse):
        assert one["points"] == 300
        assert one["ratio"] == pytest.approx(one["seconds"] / one["expected_seconds"])
        assert one["memory_ratio"] == pytest.approx(one["peak_memory_mb"] / one["expected_memory_mb"])
        assert one["stages"]["fit"] > 0
    assert "nine of ten within" in capsys.readouterr().out


def test_a_run_that_fails_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "letter.ply").write_text("Dear all,")
    words = ["--counts", "--scans", str(tmp_path / "letter.ply"), "--qualities", "draft", "--resolutions"]
    assert estimates(words) == ExitCode.BATCH
    assert "failed" in capsys.readouterr().out


def test_the_spread_is_a_factor_about_the_mean() -> None:
    assert spread([0.5, 2.0]) == pytest.approx((1.0, 2.0))


def test_senseless_arguments_are_refused() -> None:
    with pytest.raises(UsageError, match="at least 100 points"):
        estimates(["--counts", "10"])
