"""What the page says of the scan: each count that is not zero, and the warnings of the run."""

from __future__ import annotations

from gnrecon.report.html.facts import ingest, remarks


def test_every_reason_has_its_bar() -> None:
    counts = {"read": 100, "repeated": 20, "clusters": 5, "held_out": 10, "outliers": 0, "kept": 65}
    bars = {bar.fact.label: bar for bar in ingest({"ingest": counts})}
    assert list(bars) == [
        "read",
        "in a repeated copy of the scan",
        "in isolated clusters",
        "held out for validation",
        "fitted",
    ]
    assert bars["in isolated clusters"].width == 0.05
    assert [bar.kept for bar in bars.values()] == [True, False, False, False, True]
    assert ingest({}) == []


def test_what_troubles_a_scan_is_told() -> None:
    layers = {"share": 0.5, "offset": 0.25}
    told = remarks({"ingest": {"normals": "given", "clusters_found": 7}, "scan": {"layers": layers}})
    assert told[:2] == ["Normals: given.", "Kept 7 points in isolated clusters."]
    assert "At 50% of the points there are two layers, about 0.25 file units apart" in told[2]
    assert remarks({"scan": {"layers": None}}) == remarks({"scan": None}) == []
