"""What is said of a scan, and of a run without making it; nothing is written."""

from __future__ import annotations

import json
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from made_shapes import sphere
from scan_files import write_scan

from gnrecon.cli.app import main
from gnrecon.report.schema import report_schema


def said(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    with pytest.raises(SystemExit) as ended:
        main([str(word) for word in words])
    assert ended.value.code == 0
    return capsys.readouterr().out


def test_facts_and_plan(repository: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scan = repository / "sample_data/bracket_sparse.ply"
    found = json.loads(said(capsys, "info", scan, "--json"))
    assert found["points"] == found["reading"]["points"] == 4000
    assert found["normals"] == "good"
    assert found["plan"]["points"] <= 4000
    assert 6 < found["plan"]["seconds"] < 24
    assert 500 < found["plan"]["memory_mb"] < 2000
    target = tmp_path / "mesh.ply"
    assert "would fit 500 points" in said(capsys, scan, "-o", target, "--dry-run", "--max-points", "500")
    assert list(tmp_path.iterdir()) == []


def test_facts_follow_the_schema_of_the_report(repository: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = json.loads(said(capsys, "info", repository / "sample_data/knot_noisy.ply", "--json"))
    schema = report_schema()["properties"]["scan"]
    jsonschema.validate({name: found[name] for name in schema["properties"]}, schema)
    # 0.37 mm along the rays, which meet the surface at all angles up to 75 degrees.
    assert 0.2 < found["noise"] < 0.4
    assert found["units_guess"] == "mm"


def test_a_troubled_scan_is_described(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(0)
    points, normals = sphere(5000, rng)
    double = points + np.where(rng.uniform(size=(5000, 1)) < 0.5, 0.05, 0) * normals
    dust = 0.02 * rng.normal(size=(20, 3)) + [3, 0, 0]
    cut = np.vstack([double[points[:, 2] < 0.5], dust])
    scan = write_scan(tmp_path / "ball.ply", 100 * cut, np.vstack([3 * normals[points[:, 2] < 0.5], normals[:20]]))
    text = said(capsys, "info", scan)
    lines = {name: rest.strip() for name, _, rest in (line.partition(":") for line in text.splitlines())}
    assert "20 in isolated clusters" in lines["points"]
    assert lines["unit"].startswith("perhaps mm, a guess: its longest side would be 4")
    assert lines["normals"] == "good, but not of length one"
    assert lines["surface"].startswith("open, or with holes: ")
    assert lines["layers"].startswith("two, about 5")
    assert "points in isolated clusters." in text
    assert "there are two layers" in text
    assert "seconds on two idle cores" in text


def test_a_run_that_was_not_measured_is_not_estimated(
    repository: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scan = repository / "sample_data/bracket_sparse.ply"
    text = said(capsys, scan, "-o", tmp_path / "mesh.ply", "--dry-run", "--widths", "300", "--units", "mm")
    assert "layers of 300 sines, in 4 steps" in text
    assert "No estimate of time and memory" in text
    assert "mm, as given" in text
