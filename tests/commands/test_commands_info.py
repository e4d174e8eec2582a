"""``gnrecon info`` and ``--dry-run``: facts as text and as JSON, and nothing written."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from gnrecon.cli import main


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
    assert "spacing:" in said(capsys, "info", scan)
    target = tmp_path / "mesh.ply"
    assert "would fit 500 points" in said(capsys, scan, "-o", target, "--dry-run", "--max-points", "500")
    assert list(tmp_path.iterdir()) == []
