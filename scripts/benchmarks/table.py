"""The table of figures that a comparison prints: gnrecon and Poisson side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from rich.table import Table


@dataclass(frozen=True)
class Figure:
    """A line of the table.

    Parameters
    ----------
    key : name of the figure in a trial's record
    label : what the line is called
    factor : what the figure is multiplied by
    digits : decimals
    ratio : whether gnrecon / Poisson means anything
    """

    key: str
    label: str
    factor: float = 1.0
    digits: int = 0
    ratio: bool = True


FIGURES = (
    Figure("reference_to_mesh_mean", "truth to mesh, mean", 1e3, 3),
    Figure("mesh_to_reference_mean", "mesh to truth, mean", 1e3, 3),
    Figure("chamfer_mean", "symmetric mean", 1e3, 3),
    Figure("hausdorff", "Hausdorff", 1e3, 1),
    Figure("normal_consistency", "normal consistency", digits=4, ratio=False),
    Figure("components", "components", ratio=False),
    Figure("seconds", "seconds", digits=1),
    Figure("peak_memory_mb", "peak memory, MB"),
)


def comparison_table(summaries: Sequence[dict[str, Any]], seeds: int) -> Table:
    """Return a table of the summaries that `comparison.summarise` gives, a block a case."""
    caption = "Distances in 1e-3 of the shape's radius; ratio is gnrecon / Poisson; Poisson at its best depth"
    table = Table(caption=caption + (f"; medians over {seeds} seeds." if seeds > 1 else "."))
    for heading in ("case", "figure"):
        table.add_column(heading, no_wrap=True)
    for heading in ("gnrecon", "Poisson", "ratio"):
        table.add_column(heading, justify="right", no_wrap=True)
    for summary in summaries:
        depth = summary["Poisson"].get("settings", {}).get("depth")
        table.add_row(summary["case"], "octree depth", "", "failed" if depth is None else str(depth), "")
        for row, figure in enumerate(FIGURES):
            values = [_cell(summary[method], figure) for method in ("gnrecon", "Poisson")]
            ratio = summary["ratio"].get(figure.key)
            points = f"{summary['points']:,} points" if row == 0 else ""
            table.add_row(points, figure.label, *values, "" if ratio is None else f"{ratio:.2f}")
        table.add_section()
    return table


def failures(summaries: Sequence[dict[str, Any]]) -> list[str]:
    """Return a sentence for every method that failed on a case."""
    return [
        f"{summary['case']}, {method}: {summary[method]['error']}"
        for summary in summaries
        for method in ("gnrecon", "Poisson")
        if "error" in summary[method]
    ]


def _cell(summary: dict[str, Any], figure: Figure) -> str:
    return "failed" if "error" in summary else f"{figure.factor * summary[figure.key]:,.{figure.digits}f}"
