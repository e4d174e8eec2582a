"""What `gnrecon info` expects a run to take, compared with what the run takes: seconds and memory.

Scans are rippled balls (`scaling_run.Ball`), the sample scans, and files that are named. Each is reconstructed by
``gnrecon SCAN -o MESH`` in a process of its own, in each quality and at each resolution. A ratio is measured over
expected: above one, the run took more than it was said to.
"""

from __future__ import annotations

import io
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.harness import command_line
from benchmarks.harness.measurement import GNRECON, run_command
from benchmarks.harness.tables import Figure, row_table
from benchmarks.scaling_run import Ball
from gnrecon.cli.scan_info import info
from gnrecon.io import write_cloud
from gnrecon.runtime.errors import ExitCode, UsageError

FIGURES = (
    Figure("points", "points", "{:,}"),
    Figure("faces", "faces", "{:,}"),
    Figure("seconds", "s", "{:.1f}"),
    Figure("expected_seconds", "expected", "{:.1f}"),
    Figure("ratio", "ratio", "{:.2f}"),
    Figure("peak_memory_mb", "MB"),
    Figure("expected_memory_mb", "expected"),
    Figure("memory_ratio", "ratio", "{:.2f}"),
)


def main(arguments: Sequence[str]) -> int:
    """Run the benchmark with arguments; return the exit code, that of a batch where a run failed.

    Raises
    ------
    UsageError
        When a ball is too small.
    OutputError
        When the result cannot be written.
    """
    parser = command_line.benchmark_parser("estimate", __doc__)
    samples = Path(__file__).resolve().parents[2] / "sample_data"
    parser.add_argument("--counts", nargs="*", type=int, default=(500, 2000, 20_000), metavar="N", help="of the balls")
    parser.add_argument("--scans", nargs="*", type=Path, default=sorted(samples.glob("*.ply")), metavar="FILE")
    parser.add_argument("--qualities", nargs="+", default=("draft", "normal", "high"), metavar="NAME")
    parser.add_argument("--resolutions", nargs="*", type=int, default=(128, 512), metavar="N", help="besides the usual")
    parser.add_argument("--threads", type=command_line.positive, default=2, metavar="N")
    command_line.add_outputs(parser)
    chosen = parser.parse_args(arguments)
    if min(chosen.counts, default=100) < 100:
        raise UsageError("A ball must have at least 100 points.")
    command_line.require_folders(chosen.json)
    console = Console(highlight=False, width=120)
    report: dict[str, Any] = command_line.provenance("estimate", arguments) | {"runs": []}
    with command_line.scratch_folder() as folder:
        for scan in [*_balls(chosen.counts, folder), *chosen.scans]:
            for options in _variants(chosen.qualities, chosen.resolutions):
                console.print(f"bench: {scan.name} {_shown(options)}", style="dim")
                report["runs"].append(_compared(scan, options, chosen.threads, folder))
                command_line.write_report(chosen.json, report)
    console.print(table(report["runs"]))
    return ExitCode.BATCH if any("error" in one for one in report["runs"]) else ExitCode.OK


def _balls(counts: Iterable[int], folder: Path) -> list[Path]:
    """Write the balls into a folder."""
    files = [folder / f"ball_{count}.ply" for count in counts]
    for count, file in zip(counts, files, strict=True):
        write_cloud(Ball(count).scan(), file)
    return files


def _variants(qualities: Sequence[str], resolutions: Sequence[int]) -> list[dict[str, Any]]:
    """Return the options of a scan's runs: each quality, and each resolution in the first of them."""
    by_resolution = [{"quality": qualities[0], "resolution": cells} for cells in resolutions]
    return [*({"quality": name} for name in qualities), *by_resolution]


def _shown(options: Mapping[str, Any]) -> str:
    return " ".join(f"{name} {value}" for name, value in options.items())


def _compared(scan: Path, options: dict[str, Any], threads: int, folder: Path) -> dict[str, Any]:
    """Return what a run took, and what was expected of it."""
    head = {"scan": scan.stem, "options": options}
    mesh, report = folder / "mesh.ply", folder / "report.json"
    words = [str(scan), "-o", str(mesh), "--overwrite", "--quiet", f"--threads={threads}", "--report", str(report)]
    taken = run_command([*GNRECON, *words, *(f"--{name}={value}" for name, value in options.items())], threads)
    if "error" in taken:
        return head | taken
    found, plan = json.loads(report.read_text(encoding="utf-8")), _plan(scan, options)
    return {
        **head,
        **taken,
        "points": found["ingest"]["kept"],
        "faces": found["mesh"]["faces"],
        "stages": {stage["name"]: stage["cpu_seconds"] for stage in found["stages"]},
        "expected_seconds": plan["seconds"],
        "expected_memory_mb": plan["memory_mb"],
        "ratio": taken["seconds"] / plan["seconds"],
        "memory_ratio": taken["peak_memory_mb"] / plan["memory_mb"],
    }


def _plan(scan: Path, options: dict[str, Any]) -> dict[str, Any]:
    """Return what ``gnrecon info`` says of a run."""
    with redirect_stdout(io.StringIO()) as printed:
        info([scan], options, as_json=True)
    plan: dict[str, Any] = json.loads(printed.getvalue())["plan"]
    return plan


def spread(ratios: Sequence[float]) -> tuple[float, float]:
    """Return the geometric mean of ratios, and the factor about it, up or down, that holds nine of ten."""
    logarithms = np.log(ratios)
    middle = float(logarithms.mean())
    return math.exp(middle), math.exp(float(np.quantile(np.abs(logarithms - middle), 0.9)))


def table(runs: Sequence[dict[str, Any]]) -> Table:
    """Return the figures, a row for each run."""
    rows = [(one["scan"], _shown(one["options"]), *(figure.cell(one) for figure in FIGURES)) for one in runs]
    caption = ""
    if whole := [one for one in runs if "error" not in one]:
        parts = [
            (name, spread([one[key] for one in whole])) for name, key in (("Time", "ratio"), ("Memory", "memory_ratio"))
        ]
        caption = " ".join(
            f"{name}: {mean:.2f} of the expected, nine of ten within {factor:.2f}." for name, (mean, factor) in parts
        )
    return row_table(("scan", "options", *(figure.label for figure in FIGURES)), rows, caption=caption)
