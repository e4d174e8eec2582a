"""Extraction at growing resolutions: field evaluations, time and peak memory, compared with the whole grid."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.table import Table

from benchmarks.engine.cost_growth import exponent
from benchmarks.harness import command_line
from benchmarks.harness.measurement import run_isolated
from benchmarks.harness.tables import Figure, column_table
from gnrecon.runtime.errors import ExitCode, FitError, InputError, UsageError

FIGURES = (
    Figure("faces", "faces", "{:,}"),
    Figure("evaluations", "field evaluations", "{:,}"),
    Figure("share", "share of the full grid's", "{:.2%}"),
    Figure("seconds", "extraction, s", "{:.1f}"),
    Figure("cpu_seconds", "of processor time, s", "{:.1f}"),
    Figure("project_seconds", "projection, s", "{:.1f}"),
    Figure("project_cpu_seconds", "of processor time, s", "{:.1f}"),
    Figure("peak_memory_mb", "peak memory, MB"),
)


def main(arguments: Sequence[str]) -> int:
    """Run the benchmark with arguments; return the exit code, that of a batch where a measurement failed.

    Raises
    ------
    InputError
        When the scan or the model is missing.
    FitError
        When the scan cannot be fitted.
    OutputError
        When the result cannot be written.
    UsageError
        When a resolution is below 16 cells.
    """
    chosen = _parser().parse_args(arguments)
    _check(chosen)
    report: dict[str, Any] = command_line.provenance("export", arguments) | {"threads": torch.get_num_threads()}
    console = Console(highlight=False)
    with command_line.scratch_folder() as folder:
        model = str(chosen.model) if chosen.model else _fitted(chosen.scan, folder)
        report["extractions"] = []
        for cells in chosen.resolutions:
            console.print(f"bench: {cells} cells", style="dim")
            figures = _isolated("measure_extraction", folder / str(cells), model=model, resolution=cells)
            report["extractions"].append({"resolution": cells} | figures)
        if chosen.whole:
            console.print(f"bench: the whole grid of {chosen.whole} cells", style="dim")
            report["whole"] = _isolated("measure_whole_grid", folder / "whole", model=model, resolution=chosen.whole)
    report["exponents"] = _exponents(report["extractions"])
    command_line.write_report(chosen.json, report)
    console.print(table(report["extractions"]))
    for sentence in sentences(report):
        console.print(sentence, soft_wrap=True)
    return ExitCode.OK if _passed(report) else ExitCode.BATCH


def table(extractions: Sequence[dict[str, Any]]) -> Table:
    """Return the figures, a column per resolution."""
    caption = "Each resolution in a process of its own; memory includes Python and the libraries."
    headings = [f"{one['resolution']:,}" for one in extractions]
    return column_table(extractions, headings, FIGURES, "cells along the longest side", caption)


def sentences(report: dict[str, Any]) -> list[str]:
    """Return how the figures grow, whether the whole grid agrees, and what failed, in sentences."""
    said = [f"{one['resolution']} cells: {one['error']}" for one in report["extractions"] if "error" in one]
    growth = {name: value for name, value in report["exponents"].items() if value is not None}
    said += [f"Over the resolution, {name} grow with the power {value:.2f}." for name, value in growth.items()]
    whole = report.get("whole")
    if whole is None:
        return said
    if "error" in whole:
        return [*said, f"The whole grid: {whole['error']}"]
    agrees = "agrees" if whole["same"] else "does NOT agree"
    return [
        *said,
        f"Marching cubes on all {whole['nodes']:,} nodes {agrees} vertex for vertex and face for face: "
        f"{whole['vertices']:,} vertices and {whole['faces']:,} faces, ours {whole['our_vertices']:,} and "
        f"{whole['our_faces']:,}, at most {whole['farthest']:.1e} cells apart.",
    ]


def _parser() -> argparse.ArgumentParser:
    sample = command_line.REPOSITORY / "sample_data" / "bracket_sparse.ply"
    parser = command_line.benchmark_parser("export", __doc__)
    source = parser.add_mutually_exclusive_group()
    source.add_argument(
        "--scan",
        type=Path,
        default=sample,
        metavar="FILE",
        help=f"scan to fit by default options (default: {sample.name})",
    )
    source.add_argument("--model", type=Path, metavar="FILE", help="fitted field (.gnr) instead of a scan")
    parser.add_argument(
        "--resolutions",
        type=int,
        nargs="+",
        default=(256, 512, 1024),
        metavar="N",
        help="cells (default: 256 512 1024)",
    )
    parser.add_argument(
        "--whole", type=int, default=256, metavar="N", help="cells of the whole grid; 0: none (default: 256)"
    )
    command_line.add_outputs(parser)
    return parser


def _check(chosen: argparse.Namespace) -> None:
    """Check the arguments before the work."""
    if min(*chosen.resolutions, chosen.whole or 16) < 16:
        raise UsageError("Resolutions must be at least 16 cells.")
    source = chosen.model or chosen.scan
    if not source.is_file():
        raise InputError(f"There is no file {source}.")
    command_line.require_folders(chosen.json)


def _fitted(scan: Path, folder: Path) -> str:
    model = str(folder / "model.gnr")
    figures = _isolated("fit_scan", folder / "fit", scan=str(scan), model=model)
    if "error" in figures:
        raise FitError(figures["error"])
    return model


def _isolated(function: str, folder: Path, **arguments: Any) -> dict[str, Any]:
    return run_isolated(f"benchmarks.extraction_run:{function}", arguments, folder)


def _exponents(extractions: Sequence[dict[str, Any]]) -> dict[str, float | None]:
    done = [one for one in extractions if "error" not in one]
    names = {"evaluations": "evaluations", "seconds of extraction": "cpu_seconds", "faces": "faces"}
    sizes = [float(one["resolution"]) for one in done]
    return {name: exponent(sizes, [one[key] for one in done]) for name, key in names.items()}


def _passed(report: dict[str, Any]) -> bool:
    whole = report.get("whole", {"same": True})
    return whole.get("same", False) and not any("error" in one for one in report["extractions"])
