"""gnrecon compared with screened Poisson on the paper's two shapes: the same scans, in one run."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from benchmarks.accuracy.comparison import Protocol, best_setting, problems_of, run_case
from benchmarks.accuracy.problem import load_mesh, load_scan
from benchmarks.accuracy.scans import PAPER_SCANS, load_shape
from benchmarks.harness import command_line
from benchmarks.harness.contact_sheet import Part, Row, draw_row, write_sheet
from benchmarks.harness.tables import Figure
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.runtime.errors import ExitCode

METHODS = ("gnrecon", "Poisson")
FIGURES = (
    Figure("reference_to_mesh_mean", "truth to mesh, mean", "{:,.3f}", 1e3),
    Figure("mesh_to_reference_mean", "mesh to truth, mean", "{:,.3f}", 1e3),
    Figure("chamfer_mean", "symmetric mean", "{:,.3f}", 1e3),
    Figure("hausdorff", "Hausdorff", "{:,.1f}", 1e3),
    Figure("normal_consistency", "normal consistency", "{:,.4f}"),
    Figure("components", "components"),
    Figure("seconds", "seconds", "{:,.1f}"),
    Figure("peak_memory_mb", "peak memory, MB"),
)


def main(arguments: Sequence[str], protocol: Protocol | None = None) -> int:
    """Run the benchmark with arguments; return the exit code, that of a batch with failures if a method failed.

    Raises
    ------
    InputError
        When a shape's file is missing or cannot be read.
    OutputError
        When a result cannot be written.
    """
    chosen = _parser().parse_args(arguments)
    protocol = protocol or Protocol()
    command_line.require_folders(chosen.json, chosen.picture)
    for name in chosen.cases:
        load_shape(PAPER_SCANS[name].shape, chosen.data)  # fails now if a file is missing, not after other cases
    report = command_line.provenance("paper", arguments) | {
        "protocol": asdict(protocol),
        "seeds": list(range(chosen.repeat)),
    }
    with command_line.scratch_folder() as folder:
        trials = [
            run_case(
                name, problems_of(PAPER_SCANS[name], chosen.data), report["seeds"], METHODS, protocol, folder / name
            )
            for name in chosen.cases
        ]
        summaries = [summarise(records) for records in trials]
        Console(highlight=False).print(comparison_table(summaries, chosen.repeat))
        report |= command_line.without_folders(
            {"summary": summaries, "trials": [record for case in trials for record in case]}
        )
        command_line.write_report(chosen.json, report)
        if chosen.picture:
            rows = [draw_row(_row(summary, folder / summary["case"])) for summary in summaries]
            write_sheet(rows, chosen.picture)
    failed = failures(summaries)
    print(*failed, sep="\n", end="\n" if failed else "")
    return ExitCode.BATCH if failed else ExitCode.OK


def _row(summary: dict[str, Any], folder: Path) -> Row:
    """Return the first seed's row of the contact sheet, from the files of its trials."""
    shape = PAPER_SCANS[summary["case"]].shape
    parts: dict[str, Part] = {
        f"{summary['case']}: {summary['points']:,} points": PointCloud(*load_scan(folder / "scan-0.npz"))
    }
    for method in METHODS:
        result = summary[method]
        failed = "error" in result
        title = f"{method}: failed" if failed else f"{method}: {1e3 * result['chamfer_mean']:.2f}e-3"
        parts[title] = result["error"] if failed else load_mesh(Path(result["folder"]) / "mesh.npz")
    return Row(parts | {"truth": load_mesh(folder / "truth.npz")}, shape.up, shape.view)


def _parser(*, default_cases: Sequence[str] = ("rockerarm-5", "rockerarm-20", "bunny-20")) -> argparse.ArgumentParser:
    parser = command_line.benchmark_parser("paper", __doc__)
    command_line.add_data(parser, "rocker-arm.off and bun_zipper.ply", "paper")
    parser.add_argument(
        "--cases",
        nargs="+",
        choices=PAPER_SCANS,
        default=default_cases,
        metavar="CASE",
        help=f"of {', '.join(PAPER_SCANS)} (default: {' '.join(default_cases)})",
    )
    command_line.add_repeat(parser, "random choices of points")
    command_line.add_outputs(parser, picture="write a contact sheet")
    return parser


def comparison_table(summaries: Sequence[dict[str, Any]], seeds: int) -> Table:
    """Return a table of the summaries that `summarise` returns, a block per case."""
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
            values = [figure.cell(summary[method]) for method in METHODS]
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
        for method in METHODS
        if "error" in summary[method]
    ]


def summarise(records: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the medians over seeds of each method's figures for one case, and the ratios gnrecon / Poisson.

    A method whose every setting failed for some seed is given by its error.
    """
    keys = [figure.key for figure in FIGURES]
    methods = {name: best_setting([r for r in records if r["method"] == name], keys) for name in METHODS}
    ours, theirs = methods.values()
    failed = "error" in ours or "error" in theirs
    meaningless = {"normal_consistency", "components"}
    compared = [] if failed else [key for key in keys if key not in meaningless]
    # Poisson can be exact where the truth is flat: there is no ratio to zero.
    ratio = {key: ours[key] / theirs[key] for key in compared if theirs[key]}
    return {"case": records[0]["case"], "points": records[0]["points"], **methods, "ratio": ratio}
