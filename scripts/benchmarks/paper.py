"""The main job on the paper's two shapes: gnrecon beside screened Poisson, on the same scans, in one run."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from rich.console import Console

from benchmarks.arrays import load_mesh, load_scan
from benchmarks.cases import CASES, DEFAULT_CASES, load
from benchmarks.comparison import Protocol, problems_of, run_case, summarise
from benchmarks.provenance import REPOSITORY, provenance
from benchmarks.sheet import Part, Row, draw_row, write_sheet
from benchmarks.table import comparison_table, failures
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.runtime.errors import ExitCode, OutputError
from gnrecon.runtime.files import write_text

METHODS = ("gnrecon", "Poisson")
DATA = REPOSITORY.parent / "shared/data/paper"


def main(arguments: Sequence[str], protocol: Protocol | None = None) -> int:
    """Run the benchmark as the arguments say; return the exit code, that of a batch with failures if a method failed.

    Raises
    ------
    InputError
        When a shape's file is missing or cannot be read.
    OutputError
        When a result cannot be written.
    """
    chosen = _parser().parse_args(arguments)
    protocol = protocol or Protocol()
    require_folders(chosen.json, chosen.picture)
    # A missing file is to be told now, not after the cases before it.
    for name in chosen.cases:
        load(CASES[name].shape, chosen.data)
    report = provenance("paper", arguments) | {"protocol": asdict(protocol), "seeds": list(range(chosen.repeat))}
    with TemporaryDirectory(prefix="gnrecon-bench-") as temporary:
        folder = Path(temporary)
        trials = {
            name: run_case(
                name, problems_of(CASES[name], chosen.data), report["seeds"], METHODS, protocol, folder / name
            )
            for name in chosen.cases
        }
        summaries = [summarise(records) for records in trials.values()]
        Console(highlight=False).print(comparison_table(summaries, chosen.repeat))
        if chosen.json:
            records = [record for case in trials.values() for record in case]
            report |= {"summary": lasting(summaries), "trials": lasting(records)}
            write_text(chosen.json, json.dumps(report, indent=2) + "\n", overwrite=True)
        if chosen.picture:
            rows = [draw_row(_row(summary, folder / summary["case"])) for summary in summaries]
            write_sheet(rows, chosen.picture)
    failed = failures(summaries)
    print(*failed, sep="\n", end="\n" if failed else "")
    return ExitCode.BATCH if failed else ExitCode.OK


def _row(summary: dict[str, Any], folder: Path) -> Row:
    """Return the first seed's row of the contact sheet, from the files of its trials."""
    shape = CASES[summary["case"]].shape
    parts: dict[str, Part] = {
        f"{summary['case']}: {summary['points']:,} points": PointCloud(*load_scan(folder / "scan-0.npz"))
    }
    for method in METHODS:
        result = summary[method]
        failed = "error" in result
        title = f"{method}: failed" if failed else f"{method}: {1e3 * result['chamfer_mean']:.2f}e-3"
        parts[title] = result["error"] if failed else load_mesh(Path(result["folder"]) / "mesh.npz")
    return Row(parts | {"truth": load_mesh(folder / "truth.npz")}, shape.up, shape.view)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="bench paper", description=__doc__)
    parser.add_argument(
        "--data", type=Path, default=DATA, metavar="DIR", help="folder of rocker-arm.off and bun_zipper.ply"
    )
    parser.add_argument(
        "--cases",
        nargs="+",
        choices=CASES,
        default=DEFAULT_CASES,
        metavar="CASE",
        help=f"of {', '.join(CASES)} (default: {' '.join(DEFAULT_CASES)})",
    )
    parser.add_argument("--repeat", type=positive, default=1, metavar="N", help="random choices of points (default: 1)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all numbers; an older file is replaced")
    parser.add_argument(
        "--picture", type=Path, metavar="FILE", help="write a contact sheet (PNG); an older file is replaced"
    )
    return parser


def positive(text: str) -> int:
    """Return the number that an argument is; argparse tells the user where it is none."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"a positive whole number was expected, not {text!r}")
    return int(text)


def require_folders(*files: Path | None) -> None:
    """Refuse before the work what could not be written after it."""
    for file in files:
        if file is not None and not file.absolute().parent.is_dir():
            raise OutputError(f"{file} cannot be written: its folder does not exist.")


def lasting(records: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return records without the names of temporary folders, which lie in them and in the methods within."""
    return [
        {
            key: lasting([value])[0] if isinstance(value, dict) else value
            for key, value in record.items()
            if key != "folder"
        }
        for record in records
    ]
