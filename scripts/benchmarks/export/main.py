"""Extraction at growing resolutions: field evaluations, time and peak memory, and the whole grid beside it."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from rich.console import Console
from rich.table import Table

from benchmarks.engine.cost import exponent
from benchmarks.engine.process import run_alone
from benchmarks.provenance import REPOSITORY, provenance
from gnrecon.runtime.errors import ExitCode, FitError, InputError, OutputError, UsageError
from gnrecon.runtime.files import write_text

SCAN = REPOSITORY / "sample_data/bracket_sparse.ply"
RESOLUTIONS, WHOLE = (256, 512, 1024), 256


def main(arguments: Sequence[str]) -> int:
    """Run the benchmark as the arguments say; return the exit code, that of a batch where a measurement failed.

    Raises
    ------
    InputError
        When the scan or the model is missing.
    FitError
        When the scan cannot be fitted.
    OutputError
        When the result cannot be written.
    UsageError
        When a resolution makes no sense.
    """
    chosen = _parser().parse_args(arguments)
    _check(chosen)
    report: dict[str, Any] = provenance("export", arguments) | {"threads": torch.get_num_threads()}
    console = Console(highlight=False)
    with TemporaryDirectory(prefix="gnrecon-bench-") as temporary:
        folder = Path(temporary)
        model = str(chosen.model) if chosen.model else _fitted(chosen.scan, folder)
        report["extractions"] = []
        for cells in chosen.resolutions:
            console.print(f"bench: {cells} cells", style="dim")
            figures = _alone("extraction", folder / str(cells), model=model, resolution=cells)
            report["extractions"].append({"resolution": cells} | figures)
        if chosen.whole:
            console.print(f"bench: the whole grid of {chosen.whole} cells", style="dim")
            report["whole"] = _alone("whole_grid", folder / "whole", model=model, resolution=chosen.whole)
    report["exponents"] = _exponents(report["extractions"])
    if chosen.json:
        write_text(chosen.json, json.dumps(report, indent=2) + "\n", overwrite=True)
    console.print(table(report["extractions"]))
    for sentence in sentences(report):
        console.print(sentence, soft_wrap=True)
    return ExitCode.OK if _passed(report) else ExitCode.BATCH


def table(extractions: Sequence[dict[str, Any]]) -> Table:
    """Return the figures, a column a resolution."""
    shown = Table(caption="Each resolution in a process of its own; memory includes Python and the libraries.")
    shown.add_column("cells along the longest side", no_wrap=True)
    for figures in extractions:
        shown.add_column(f"{figures['resolution']:,}", justify="right", no_wrap=True)
    for key, label, form in _ROWS:
        shown.add_row(label, *("failed" if "error" in one else form.format(one[key]) for one in extractions))
    return shown


_ROWS = (
    ("faces", "faces", "{:,}"),
    ("evaluations", "field evaluations", "{:,}"),
    ("share", "share of the full grid's", "{:.2%}"),
    ("seconds", "extraction, s", "{:.1f}"),
    ("cpu_seconds", "of processor time, s", "{:.1f}"),
    ("project_seconds", "projection, s", "{:.1f}"),
    ("project_cpu_seconds", "of processor time, s", "{:.1f}"),
    ("peak_memory_mb", "peak memory, MB", "{:,.0f}"),
)


def sentences(report: dict[str, Any]) -> list[str]:
    """Say how the figures grow, whether the whole grid agrees, and what failed."""
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
    parser = argparse.ArgumentParser(prog="bench export", description=__doc__)
    source = parser.add_mutually_exclusive_group()
    source.add_argument(
        "--scan", type=Path, default=SCAN, metavar="FILE", help=f"scan to fit by default options (default: {SCAN.name})"
    )
    source.add_argument("--model", type=Path, metavar="FILE", help="fitted field (.gnr) instead of a scan")
    parser.add_argument(
        "--resolutions", type=int, nargs="+", default=RESOLUTIONS, metavar="N", help="cells (default: 256 512 1024)"
    )
    parser.add_argument(
        "--whole", type=int, default=WHOLE, metavar="N", help="cells of the whole grid; 0: none (default: 256)"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all numbers; an older file is replaced")
    return parser


def _check(chosen: argparse.Namespace) -> None:
    """Refuse before the work what would be refused after it."""
    if min(*chosen.resolutions, chosen.whole or 16) < 16:
        raise UsageError("Resolutions must be at least 16 cells.")
    source = chosen.model or chosen.scan
    if not source.is_file():
        raise InputError(f"There is no file {source}.")
    if chosen.json is not None and not chosen.json.absolute().parent.is_dir():
        raise OutputError(f"{chosen.json} cannot be written: its folder does not exist.")


def _fitted(scan: Path, folder: Path) -> str:
    model = str(folder / "model.gnr")
    figures = _alone("fitting", folder / "fit", scan=str(scan), model=model)
    if "error" in figures:
        raise FitError(figures["error"])
    return model


def _alone(module: str, folder: Path, **arguments: Any) -> dict[str, Any]:
    return run_alone(f"benchmarks.export.{module}", "measure", folder, **arguments)


def _exponents(extractions: Sequence[dict[str, Any]]) -> dict[str, float | None]:
    done = [one for one in extractions if "error" not in one]
    names = {"evaluations": "evaluations", "seconds of extraction": "cpu_seconds", "faces": "faces"}
    sizes = [float(one["resolution"]) for one in done]
    return {name: exponent(sizes, [one[key] for one in done]) for name, key in names.items()}


def _passed(report: dict[str, Any]) -> bool:
    return not any("error" in one for one in report["extractions"]) and report.get("whole", {"same": True}).get(
        "same", False
    )
