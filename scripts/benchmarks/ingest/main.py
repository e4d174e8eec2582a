"""Large scans streamed through voxel thinning: points a second and peak memory, each format in a process of its own."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from rich.console import Console
from rich.table import Table

from benchmarks.engine.process import run_alone
from benchmarks.ingest.scans import WRITERS
from benchmarks.provenance import provenance
from gnrecon.io import IOParameters
from gnrecon.runtime.errors import ExitCode, OutputError, UsageError
from gnrecon.runtime.files import write_text

POINTS = 20_000_000
_ROWS = (
    ("bytes", "size of the file, MB", 1e-6, "{:,.0f}"),
    ("kept", "points kept", 1, "{:,.0f}"),
    ("seconds", "seconds", 1, "{:.1f}"),
    ("cpu_seconds", "of processor time", 1, "{:.1f}"),
    ("points_per_second", "million points a second", 1e-6, "{:.2f}"),
    ("points_per_cpu_second", "a second of processor time", 1e-6, "{:.2f}"),
    ("peak_memory_mb", "peak memory, MB", 1, "{:,.0f}"),
)


def main(arguments: Sequence[str]) -> int:
    """Run the benchmark as the arguments say; return the exit code, that of a batch where a measurement failed.

    Raises
    ------
    UsageError
        When a format or a number makes no sense.
    OutputError
        When the result cannot be written.
    """
    chosen = _parser().parse_args(arguments)
    if chosen.points < 1 or chosen.keep < 1:
        raise UsageError("The numbers of points and of those to keep must be positive.")
    if chosen.json and not chosen.json.parent.is_dir():
        raise OutputError(f"{chosen.json} cannot be written: its folder does not exist.")
    report: dict[str, Any] = provenance("ingest", arguments) | {"points": chosen.points, "scans": []}
    console = Console(highlight=False)
    for name in chosen.formats:
        console.print(f"bench: {chosen.points:,} points as {name}", style="dim")
        report["scans"].append({"format": name} | _one(name, chosen))
    if chosen.json:
        write_text(chosen.json, json.dumps(report, indent=2) + "\n", overwrite=True)
    console.print(table(report["scans"]))
    return ExitCode.BATCH if any("error" in one for one in report["scans"]) else ExitCode.OK


def table(scans: Sequence[dict[str, Any]]) -> Table:
    """Return the figures, a column a format."""
    shown = Table(caption="Each format in a process of its own; memory includes Python and the libraries.")
    shown.add_column("")
    for figures in scans:
        shown.add_column(figures["format"], justify="right", no_wrap=True)
    for key, label, factor, form in _ROWS:
        shown.add_row(label, *("failed" if "error" in one else form.format(factor * one[key]) for one in scans))
    return shown


def _one(name: str, chosen: argparse.Namespace) -> dict[str, Any]:
    with TemporaryDirectory(prefix="gnrecon-bench-") as temporary:
        scan = Path(temporary) / f"scan.{name}"
        WRITERS[name](scan, chosen.points)
        where = Path(temporary) / "measured"
        return run_alone("benchmarks.ingest.reading", "measure", where, scan=str(scan), most=chosen.keep)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="bench ingest", description=__doc__)
    parser.add_argument("--points", type=int, default=POINTS, help="points in each file")
    most = IOParameters.most_points
    parser.add_argument("--keep", type=int, default=most, help="points to keep, as of --read-points")
    parser.add_argument("--formats", nargs="+", choices=list(WRITERS), default=list(WRITERS), help="formats to read")
    parser.add_argument("--json", type=Path, help="JSON file to write")
    return parser
