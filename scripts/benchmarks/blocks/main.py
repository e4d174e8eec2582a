"""Reconstructions of growing scans by blocks: time and memory for the points, seams, and distance from the truth.

Scans that are small enough to be fitted in one piece by themselves are measured so, too, beside their blocks.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from rich.console import Console
from rich.table import Table

from benchmarks.alone import run_program
from benchmarks.blocks.plot import draw
from benchmarks.engine.plot import require_matplotlib
from benchmarks.provenance import provenance
from gnrecon.fit.blocks.block_parameters import BlockParameters
from gnrecon.runtime.errors import ExitCode, OutputError, UsageError
from gnrecon.runtime.files import write_text

COUNTS = (100_000, 300_000, 1_000_000, 2_000_000)
THREADS = 2
IN_ONE = "in one piece"
_ROWS = (
    (("seconds_per_100k",), "processor seconds for 100,000 points", "{:.0f}"),
    (("cpu_seconds",), "processor seconds, all processes", "{:.0f}"),
    (("seconds",), "seconds", "{:.0f}"),
    (("memory_mb", "together"), "peak memory of all processes, MB", "{:,.0f}"),
    (("memory_mb", "own"), "of the main process", "{:,.0f}"),
    (("memory_mb", "worker"), "of the largest other", "{:,.0f}"),
    (("cubes",), "cubes", "{:,}"),
    (("cells",), "cells along the box", "{:,}"),
    (("vertices",), "vertices", "{:,}"),
    (("jump", "value"), "largest jump across borders, radii", "{:.1e}"),
    (("jump", "gradient"), "of the gradient", "{:.1e}"),
    (("to_truth", "mean"), "mean distance from the mesh to the truth, spacings", "{:.3f}"),
    (("to_truth", "max"), "largest", "{:.2f}"),
    (("missed",), "mean distance from the truth to the field's surface", "{:.3f}"),
    (("guarantee",), "as written and read back", "{}"),
)


def main(arguments: Sequence[str]) -> int:
    """Run the benchmark as the arguments say; return the exit code, that of a batch where a measurement failed.

    Raises
    ------
    UsageError
        When a number makes no sense, or there is no matplotlib for the picture.
    OutputError
        When the result cannot be written.
    """
    chosen = _parser().parse_args(arguments)
    if min(chosen.counts) < 1000:
        raise UsageError("A scan must have at least 1,000 points.")
    for path in (chosen.json, chosen.picture):
        if path and not path.parent.is_dir():
            raise OutputError(f"{path} cannot be written: its folder does not exist.")
    if chosen.picture:
        require_matplotlib()
    report: dict[str, Any] = provenance("blocks", arguments) | {"runs": []}
    console = Console(highlight=False)
    for count in sorted(chosen.counts):
        for blocks in (False, True) if count < BlockParameters.large_scan_points else (True,):
            console.print(f"bench: {count:,} points{'' if blocks else f', {IN_ONE}'}", style="dim")
            report["runs"].append({"points": count, "blocks": blocks} | _one(count, blocks, chosen))
    if chosen.json:
        write_text(chosen.json, json.dumps(report, indent=2) + "\n", overwrite=True)
    measured = [run for run in report["runs"] if "error" not in run]
    by_blocks = [run for run in measured if run["blocks"]]
    if chosen.picture and by_blocks:
        draw(by_blocks, chosen.picture)
    console.print(table(report["runs"]))
    return ExitCode.OK if len(measured) == len(report["runs"]) else ExitCode.BATCH


def table(runs: Sequence[dict[str, Any]]) -> Table:
    """Return the figures, a column a scan."""
    shown = Table(caption="A process of its own each, and what that starts; memory counts shared pages once.")
    shown.add_column("", no_wrap=True)
    for run in runs:
        heading = f"{run['points']:,}"
        shown.add_column(heading if run["blocks"] else f"{heading}\n{IN_ONE}", justify="right")
    for keys, label, form in _ROWS:
        shown.add_row(label, *(_cell(run, keys, form) for run in runs))
    return shown


def _cell(run: dict[str, Any], keys: tuple[str, ...], form: str) -> str:
    found: Any = run
    try:
        for key in keys:
            found = found[key]
    except (KeyError, TypeError):
        return "failed"
    return form.format(found)


def _one(count: int, blocks: bool, chosen: argparse.Namespace) -> dict[str, Any]:
    with TemporaryDirectory(prefix="gnrecon-bench-") as temporary:
        options = {"quality": chosen.quality, "threads": THREADS} | (
            {} if chosen.resolution is None else {"resolution": chosen.resolution}
        )
        job = {"points": count, "blocks": blocks, "options": options}
        figures = run_program("benchmarks.blocks.measure", job, 1, Path(temporary) / "job")
    if "cpu_seconds" in figures:
        figures["seconds_per_100k"] = figures["cpu_seconds"] / count * 1e5
    return figures


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="bench blocks", description=__doc__)
    parser.add_argument("--counts", nargs="+", type=int, default=COUNTS, help="points of the scans")
    parser.add_argument("--quality", default="normal", help="of the fits, as of gnrecon")
    parser.add_argument("--resolution", type=int, help="cells of the meshes, as of gnrecon")
    parser.add_argument("--json", type=Path, help="JSON file to write")
    parser.add_argument("--picture", type=Path, help="PNG file to write")
    return parser
