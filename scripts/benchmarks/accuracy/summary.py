"""Summaries of the trials of a case, their table, and how many hard cases gnrecon wins against its best peer."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from rich.table import Table

from benchmarks.accuracy.cases import hard_cases
from benchmarks.accuracy.comparison import best_setting
from benchmarks.accuracy.methods import METHODS, PEERS
from benchmarks.accuracy.problem import Problem
from benchmarks.harness.tables import Figure, number_or_dash
from gnrecon.geometry.point_cloud import PointCloud

COLUMNS = (
    Figure("reference_to_mesh_mean", "truth to mesh", "{:,.3f}", is_length=True),
    Figure("mesh_to_reference_mean", "mesh to truth", "{:,.3f}", is_length=True),
    Figure("chamfer_mean", "mean", "{:,.3f}", is_length=True),
    Figure("rms", "RMS", "{:,.3f}", is_length=True),
    Figure("hausdorff", "Hausdorff", "{:,.1f}", is_length=True),
    Figure("normal_consistency", "normals", "{:.4f}"),
    Figure("f_score", "F-score", "{:.4f}"),
    Figure("components", "parts", "{:g}"),
    Figure("genus", "genus", "{:g}"),
    Figure("closed", "closed", "{}"),
    Figure("seconds", "s", "{:,.1f}"),
    Figure("cpu_seconds", "CPU s", "{:,.1f}"),
    Figure("peak_memory_mb", "MB"),
)
SAMPLE_COLUMNS = (
    Figure("samples_chamfer", "Chamfer of samples", "{:,.3f}", is_length=True),
    Figure("samples_hausdorff", "Hausdorff of samples", "{:,.2f}", is_length=True),
)


def summarise(
    records: Sequence[dict[str, Any]], problem: Problem, stored: Sequence[dict[str, Any]] = ()
) -> dict[str, Any]:
    """Return the facts of a case, and for each of its methods the medians over seeds at the best setting.

    Distances are in the truth's own unit; `factor` converts them to the reported `unit`. `stored` are the figures of
    peers that were measured before, see `stored_peers.best_stored`.
    """
    found = [record | _derived(record) for record in records]
    names = dict.fromkeys(record["method"] for record in found)
    keys = [*(figure.key for figure in (*COLUMNS, *SAMPLE_COLUMNS)), "boundary_edges"]
    return {
        "case": records[0]["case"],
        "points": records[0]["points"],
        "genus": problem.genus,
        "against_scan": isinstance(problem.truth, PointCloud),
        "lid": problem.lid is not None,
        "unit": problem.unit,
        "factor": problem.factor,
        "methods": {name: best_setting([r for r in found if r["method"] == name], keys) for name in names},
        "stored": list(stored),
    }


@dataclass(frozen=True)
class Standing:
    """Number of hard cases in which gnrecon's symmetric mean is below the best peer's, and by a quarter or more."""

    cases: int
    below: int
    quarter: int

    def describe(self) -> str:
        """Return it as a sentence."""
        return (
            f"Of {self.cases} noisy or sparse analytic cases, gnrecon's mean distance is below the best peer's in "
            f"{self.below}, by a quarter or more in {self.quarter}."
        )


def standing(summaries: Sequence[dict[str, Any]]) -> Standing | None:
    """Return how gnrecon stands in the hard cases of `summaries`; None where none of them compares it with a peer.

    A method that failed is infinitely far from the truth.
    """
    hard = hard_cases()
    ratios = [ratio for ratio in map(_ratio, (s for s in summaries if s["case"] in hard)) if ratio is not None]
    if not ratios:
        return None
    return Standing(len(ratios), sum(ratio < 1 for ratio in ratios), sum(ratio <= 0.75 for ratio in ratios))


def best_peer(summary: dict[str, Any]) -> str | None:
    """Return the peer with the least symmetric mean; None where none was run."""
    peers = [name for name in summary["methods"] if name in PEERS]
    return min(peers, key=lambda name: _mean(summary, name), default=None)


def _ratio(summary: dict[str, Any]) -> float | None:
    peer = best_peer(summary)
    if peer is None or "gnrecon" not in summary["methods"]:
        return None
    ours, theirs = _mean(summary, "gnrecon"), _mean(summary, peer)
    if math.isinf(theirs):
        return math.inf if math.isinf(ours) else 0.0
    # Ball pivoting on a clean plane has no error at all.
    return ours / theirs if theirs else math.inf


def _mean(summary: dict[str, Any], method: str) -> float:
    return float(summary["methods"][method].get("chamfer_mean", math.inf))


def _derived(record: dict[str, Any]) -> dict[str, Any]:
    """Return the root mean square of the samples of both surfaces together, where there are any."""
    if "error" in record:
        return {}
    there, back = record["reference_to_mesh_rms"], record["mesh_to_reference_rms"]
    return {"rms": math.sqrt((there**2 + back**2) / 2)}


def accuracy_table(summaries: Sequence[dict[str, Any]], seeds: int) -> Table:
    """Return a table of the summaries of `summary.summarise`; the best peer of each case is marked with a star."""
    caption = "Mean: half the sum of both ways. F-score at 0.5 % of the radius. *: the best peer by the mean."
    caption += f" Medians over {seeds} seeds." if seeds > 1 else ""
    if any(summary["stored"] for summary in summaries):
        caption += " Stored: the peer with the least mean, and that with the least Hausdorff distance; seed 0."
    table = Table(caption=caption)
    has_samples = any(done["samples_chamfer"] is not None for summary in summaries for done in _measured(summary))
    columns = [*COLUMNS, *(SAMPLE_COLUMNS if has_samples else ())]
    table.add_column("case and method", no_wrap=True)
    for column in columns:
        table.add_column(column.label, justify="right")
    for summary in summaries:
        table.add_row(f"[bold]{summary['case']}[/bold]")
        table.add_row(f"[dim]{_described(summary)}[/dim]")
        star = best_peer(summary)
        for method, figures in summary["methods"].items():
            name = f"{method_title(method, figures)}{' *' if method == star else ''}"
            table.add_row(name, *(_cell(figures, column, summary["factor"]) for column in columns))
        for figures in summary["stored"]:
            table.add_row(_stored_title(figures), *(_cell(figures, column, summary["factor"]) for column in columns))
        table.add_section()
    return table


def _stored_title(figures: dict[str, Any]) -> str:
    others = "" if figures["same_points"] else " (other points)"
    return f"stored {figures['method']}, {figures['setting']}{others}"


def method_title(method: str, figures: dict[str, Any]) -> str:
    """Return the method's name with its reported setting."""
    settings = figures.get("settings", {})
    titles = {"depth": "depth", "filterscale": "scale"}
    return ", ".join([method, *(f"{titles[key]} {settings[key]:g}" for key in titles if key in settings)])


def failures(summaries: Sequence[dict[str, Any]]) -> list[str]:
    """Return a sentence for every method that made no mesh of a case, in the order of the methods' table."""
    return [
        f"{summary['case']}, {method}: {summary['methods'][method]['error']}"
        for summary in summaries
        for method in METHODS
        if "error" in summary["methods"].get(method, {})
    ]


def _described(summary: dict[str, Any]) -> str:
    genus = "" if summary["genus"] is None else f", genus {summary['genus']}"
    against = "; measured against the scan" if summary["against_scan"] else ""
    lid = "; open, with a flat lid" if summary["lid"] else ""
    return f"{summary['points']:,} points{genus}; {summary['unit']}{against}{lid}"


def _measured(summary: dict[str, Any]) -> list[dict[str, Any]]:
    return [figures for figures in summary["methods"].values() if "error" not in figures]


def _cell(figures: dict[str, Any], column: Figure, factor: float) -> str:
    if "error" in figures:
        return "failed" if column.key == "chamfer_mean" else ""
    # Stored figures have fewer keys than those of a trial.
    value = figures.get(column.key)
    if value is not None and column.key == "closed":
        return "yes" if value == 1 else "no"
    in_unit = factor * value if value is not None and column.is_length else value
    return number_or_dash(in_unit, column.form)
