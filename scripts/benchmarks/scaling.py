"""Reconstructions of growing scans by blocks: time and memory per point, seams, and distance from the truth.

Scans that gnrecon would fit in one piece are also measured that way, for comparison.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from benchmarks.harness import command_line
from benchmarks.harness.measurement import run_isolated
from benchmarks.harness.tables import Figure, column_table
from gnrecon.fit.blocks.block_parameters import BlockParameters
from gnrecon.runtime.errors import ExitCode, UsageError
from gnrecon.runtime.files import atomic_write

FIGURES = (
    Figure("seconds_per_100k", "processor seconds for 100,000 points"),
    Figure("cpu_seconds", "processor seconds, all processes"),
    Figure("seconds", "seconds"),
    Figure("memory_mb.together", "peak memory of all processes, MB"),
    Figure("memory_mb.own", "of the main process"),
    Figure("memory_mb.worker", "of the largest other"),
    Figure("cubes", "cubes"),
    Figure("cells", "cells along the box"),
    Figure("vertices", "vertices"),
    Figure("jump.value", "largest jump across borders, radii", "{:.1e}"),
    Figure("jump.gradient", "of the gradient", "{:.1e}"),
    Figure("to_truth.mean", "mean distance from the mesh to the truth, spacings", "{:.3f}"),
    Figure("to_truth.max", "largest", "{:.2f}"),
    Figure("missed", "mean distance from the truth to the field's surface", "{:.3f}"),
    Figure("guarantee", "as written and read back", "{}"),
)


def main(arguments: Sequence[str]) -> int:
    """Run the benchmark with arguments; return the exit code, that of a batch where a measurement failed.

    Raises
    ------
    UsageError
        When a scan is too small, or there is no matplotlib for the picture.
    OutputError
        When the result cannot be written.
    """
    chosen = _parser().parse_args(arguments)
    if min(chosen.counts) < 1000:
        raise UsageError("A scan must have at least 1,000 points.")
    command_line.require_drawable(chosen.json, chosen.picture)
    report: dict[str, Any] = command_line.provenance("blocks", arguments) | {"runs": []}
    console = Console(highlight=False)
    for count in sorted(chosen.counts):
        for blocks in (False, True) if count < BlockParameters.large_scan_points else (True,):
            console.print(f"bench: {count:,} points{'' if blocks else ', in one piece'}", style="dim")
            report["runs"].append({"points": count, "blocks": blocks} | _measure(count, blocks, chosen))
    command_line.write_report(chosen.json, report)
    measured = [run for run in report["runs"] if "error" not in run]
    by_blocks = [run for run in measured if run["blocks"]]
    if chosen.picture and by_blocks:
        draw(by_blocks, chosen.picture)
    console.print(table(report["runs"]))
    return ExitCode.OK if len(measured) == len(report["runs"]) else ExitCode.BATCH


def table(runs: Sequence[dict[str, Any]]) -> Table:
    """Return the figures, a column per scan."""
    caption = "A process of its own each, with its children; memory counts shared pages once."
    headings = [f"{run['points']:,}" + ("" if run["blocks"] else "\nin one piece") for run in runs]
    return column_table(runs, headings, FIGURES, "", caption)


def _measure(count: int, blocks: bool, chosen: argparse.Namespace, *, threads: int = 2) -> dict[str, Any]:
    options = {"quality": chosen.quality, "threads": threads}
    if chosen.resolution is not None:
        options["resolution"] = chosen.resolution
    with command_line.scratch_folder() as scratch:
        folder = scratch / "job"
        arguments = {"folder": str(folder), "points": count, "blocks": blocks, "options": options}
        figures = run_isolated("benchmarks.scaling_run:measure_blocks", arguments, folder, threads=1)
    if "cpu_seconds" in figures:
        figures["seconds_per_100k"] = figures["cpu_seconds"] / count * 1e5
    return figures


def _parser() -> argparse.ArgumentParser:
    parser = command_line.benchmark_parser("blocks", __doc__)
    parser.add_argument(
        "--counts", nargs="+", type=int, default=(100_000, 300_000, 1_000_000, 2_000_000), help="points of the scans"
    )
    parser.add_argument("--quality", default="normal", help="of the fits, as of gnrecon")
    parser.add_argument("--resolution", type=int, help="cells of the meshes, as of gnrecon")
    command_line.add_outputs(parser, picture="plot time and memory")
    return parser


def draw(runs: Sequence[dict[str, Any]], path: Path) -> None:
    """Write a PNG file with a panel of seconds and one of memory; an older file is replaced.

    Raises
    ------
    OutputError
        When the file cannot be written.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.4, 4.2), layout="constrained")
    time, memory = figure.subplots(1, 2)
    points = [run["points"] for run in runs]
    stages = {"whole run": [run["cpu_seconds"] for run in runs]}
    for name in ("ingest", "extract", "project"):
        stages[name] = [run["stage_cpu_seconds"][name] for run in runs]
    for name, seconds in stages.items():
        time.loglog(points, seconds, marker="o", label=name)
    first = stages["whole run"][0] / points[0]
    time.loglog(points, [first * count for count in points], "k:", label="in proportion to the points")
    time.set(xlabel="points", ylabel="seconds of processor time, all processes")
    for name, label in (("together", "all processes"), ("own", "main process"), ("worker", "largest other process")):
        memory.semilogx(points, [run["memory_mb"][name] / 1000 for run in runs], marker="o", label=label)
    memory.axhline(8.0, color="k", linestyle=":", label="8 GB")
    memory.set(xlabel="points", ylabel="peak memory, GB", ylim=(0, None))
    for axes in (time, memory):
        axes.legend()
        axes.grid(alpha=0.3)
    with atomic_write(path, overwrite=True) as temporary:
        figure.savefig(temporary, format="png", dpi=120)
