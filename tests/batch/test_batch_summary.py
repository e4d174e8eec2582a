"""The summary of a batch: counts that add up, a table that reads back, and a self-contained page."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path

import pytest
from PIL import Image

from gnrecon.batch.job import Cause, JobOutcome, Status
from gnrecon.batch.summary import BatchSummary, summary_csv, write_summary

FIGURES = {
    "points": 1200,
    "vertices": 900,
    "faces": 1800,
    "components": 2,
    "genus": 1,
    "closed": True,
    "area": 12.5,
    "volume": 2.25,
    "invented_area_share": 0.05,
}


@pytest.fixture
def account(tmp_path: Path) -> BatchSummary:
    thumbnail = tmp_path / "thumb.png"
    Image.new("RGB", (24, 18), (200, 30, 30)).save(thumbnail)
    files = {"mesh": str(tmp_path / "a b" / "ring.obj"), "report": str(tmp_path / "a b" / "ring.report.json")}
    metrics = {"chamfer_mean": 0.0123, "hausdorff": 0.5, "normal_consistency": None, "relative": {"hausdorff": 0.1}}
    outcomes = (
        JobOutcome("a b/ring", "s/ring.ply", Status.MADE, files=files, thumbnail=str(thumbnail), attempts=2,
                   seconds=61.0, peak_memory_mb=1234.5, figures=FIGURES, metrics=metrics),
        JobOutcome("old", "s/old.ply", Status.UNCHANGED, files={"mesh": str(tmp_path / "old.obj")}, figures=FIGURES),
        JobOutcome("torn", "s/torn.ply", Status.FAILED, Cause.INPUT, "s/torn.ply: <it> ends, early.", 3, attempts=1),
        JobOutcome("void", "s/void.ply", Status.FAILED, Cause.INPUT, "s/void.ply: the file is empty.", 3, attempts=1),
        JobOutcome("slow", "s/slow.ply", Status.FAILED, Cause.TIMEOUT, "It had not ended.", None, attempts=1),
    )  # fmt: skip
    return BatchSummary(outcomes, 6, 2, 1, 75.0, "gnrecon batch s -o <out>")


def test_the_numbers_add_up(account: BatchSummary, tmp_path: Path) -> None:
    write_summary(account, tmp_path)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert (summary["made"], summary["unchanged"], summary["failed"], summary["scans_asked_for"]) == (1, 1, 3, 6)
    assert summary["causes"] == {"input": 2, "timeout": 1}
    assert [scan["name"] for scan in summary["scans"]] == ["a b/ring", "old", "torn", "void", "slow"]
    assert summary["scans"][0]["mesh"].endswith("ring.obj")
    assert summary["scans"][0]["page"] == ""
    assert summary["scans"][4]["exit_code"] is None


def test_the_table_reads_back(account: BatchSummary) -> None:
    rows = list(csv.DictReader(io.StringIO(summary_csv(account.outcomes))))
    assert [row["cause"] for row in rows] == ["", "", "input", "input", "timeout"]
    assert rows[2]["message"] == "s/torn.ply: <it> ends, early."
    assert (rows[0]["faces"], rows[0]["chamfer_mean"], rows[3]["faces"]) == ("1800", "0.0123", "")
    assert rows[0]["mesh"].endswith("ring.obj")


def test_the_page_holds_everything_and_asks_for_nothing(account: BatchSummary, tmp_path: Path) -> None:
    write_summary(account, tmp_path)
    text = (tmp_path / "summary.html").read_text()
    assert "2 of 6 scans reconstructed; 1 were not started or not finished." in text
    assert text.count("data:image/png;base64,") == 1
    assert 'href="a%20b/ring.obj"' in text
    assert "&lt;it&gt; ends, early." in text
    assert "gnrecon batch s -o &lt;out&gt;" in text
    assert text.index("<b>2</b> input") < text.index("<b>1</b> timeout") < text.index('class="scans"')
    assert "http" not in text.replace("http-equiv", "")
