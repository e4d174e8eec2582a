"""The table of an accuracy benchmark: a block a case, a line a method."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from rich.table import Table

from benchmarks.accuracy.summary import best_peer
from benchmarks.methods import METHODS


@dataclass(frozen=True)
class Column:
    """A figure of the summaries: its key, heading and format, and whether it is a distance."""

    key: str
    heading: str
    form: str
    distance: bool = False


COLUMNS = (
    Column("reference_to_mesh_mean", "truth to mesh", "{:,.3f}", distance=True),
    Column("mesh_to_reference_mean", "mesh to truth", "{:,.3f}", distance=True),
    Column("chamfer_mean", "mean", "{:,.3f}", distance=True),
    Column("rms", "RMS", "{:,.3f}", distance=True),
    Column("hausdorff", "Hausdorff", "{:,.1f}", distance=True),
    Column("normal_consistency", "normals", "{:.4f}"),
    Column("f_score", "F-score", "{:.4f}"),
    Column("components", "parts", "{:g}"),
    Column("genus", "genus", "{:g}"),
    Column("closed", "closed", "{}"),
    Column("seconds", "s", "{:,.1f}"),
    Column("peak_memory_mb", "MB", "{:,.0f}"),
)
APART = (
    Column("samples_chamfer", "Chamfer of samples", "{:,.3f}", distance=True),
    Column("samples_hausdorff", "Hausdorff of samples", "{:,.2f}", distance=True),
)
SETTINGS = {"depth": "depth", "filterscale": "scale"}
"""What the settings that a method was tried with are called in the table."""


def accuracy_table(summaries: Sequence[dict[str, Any]], seeds: int) -> Table:
    """Return a table of the summaries of `summary.summarise`; the best peer of each case is marked with a star."""
    caption = "Mean: half the sum of both ways. F-score at 0.5 % of the radius. *: the best peer by the mean."
    table = Table(caption=caption + (f" Medians over {seeds} seeds." if seeds > 1 else ""))
    apart = any(done["samples_chamfer"] is not None for summary in summaries for done in _measured(summary))
    columns = [*COLUMNS, *(APART if apart else ())]
    table.add_column("case and method", no_wrap=True)
    for column in columns:
        table.add_column(column.heading, justify="right")
    for summary in summaries:
        table.add_row(f"[bold]{summary['case']}[/bold]")
        table.add_row(f"[dim]{_described(summary)}[/dim]")
        star = best_peer(summary)
        for method, figures in summary["methods"].items():
            name = f"{method_title(method, figures)}{' *' if method == star else ''}"
            table.add_row(name, *(_cell(figures, column, summary["factor"]) for column in columns))
        table.add_section()
    return table


def method_title(method: str, figures: dict[str, Any]) -> str:
    """Return the method's name with the setting that stands for it."""
    settings = figures.get("settings", {})
    return ", ".join([method, *(f"{SETTINGS[key]} {settings[key]:g}" for key in SETTINGS if key in settings)])


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
    return f"{summary['points']:,} points{genus}; {summary['unit']}{against}"


def _measured(summary: dict[str, Any]) -> list[dict[str, Any]]:
    return [figures for figures in summary["methods"].values() if "error" not in figures]


def _cell(figures: dict[str, Any], column: Column, factor: float) -> str:
    if "error" in figures:
        return "failed" if column.key == "chamfer_mean" else ""
    value = figures[column.key]
    if value is None:
        return "-"
    if column.key == "closed":
        return "yes" if value == 1 else "no"
    return column.form.format(factor * value if column.distance else value)
