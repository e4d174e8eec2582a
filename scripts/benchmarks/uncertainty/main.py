"""Sigma beside the true error: shares within two sigma, and rank correlation, on sparse, noisy and holed scans."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any

from rich.console import Console
from rich.table import Table

from benchmarks.paper import positive, require_folders
from benchmarks.provenance import provenance
from benchmarks.uncertainty.check import figures, run
from benchmarks.uncertainty.picture import draw_picture
from benchmarks.uncertainty.scans import CASES, Case
from gnrecon.runtime.errors import ExitCode
from gnrecon.runtime.files import write_text

OPTIONS = {"resolution": 96}
PICTURED = "bracket, holed"

COLUMNS = {
    "points": ("points", "{:,.0f}"),
    "within": ("within 2 sigma", "{:.1%}"),
    "within_near": ("near data", "{:.1%}"),
    "within_far": ("far from it", "{:.1%}"),
    "rank": ("rank corr.", "{:.2f}"),
    "rank_of_distance": ("of distance", "{:.2f}"),
    "median_sigma": ("median sigma", "{:.2f}"),
    "median_error": ("median error", "{:.2f}"),
    "factor": ("factor", "{:.2f}"),
}


def main(
    arguments: Sequence[str], cases: Mapping[str, Case] | None = None, options: dict[str, Any] | None = None
) -> int:
    """Run the benchmark as the arguments say; return the exit code.

    Raises
    ------
    OutputError
        When a result cannot be written.
    """
    cases, options = cases or CASES, options or OPTIONS
    chosen = _parser(cases).parse_args(arguments)
    require_folders(chosen.json, chosen.picture)
    report: dict[str, Any] = provenance("uncertainty", arguments) | {"options": options, "trials": []}
    for name in chosen.cases:
        for seed in range(chosen.repeat):
            print(f"bench: {name}, seed {seed}", file=sys.stderr)
            check = run(cases[name], seed, options)
            report["trials"].append({"case": name, "seed": seed} | figures(check))
            if chosen.json:
                # After each one, because the next may be stopped.
                write_text(chosen.json, json.dumps(report, indent=2) + "\n", overwrite=True)
            if chosen.picture and (name, seed) == (chosen.pictured, 0):
                draw_picture(check, chosen.picture)
    Console(highlight=False, width=140).print(table(report["trials"]))
    return ExitCode.OK


def table(trials: Sequence[dict[str, Any]]) -> Table:
    """Return a table of the trials, a line a case, medians where a case was tried with several seeds."""
    shown = Table(caption="Lengths in 1e-3 of the radius; medians over seeds. Rank correlations are with the error.")
    shown.add_column("scan", no_wrap=True)
    for heading, _ in COLUMNS.values():
        shown.add_column(heading, justify="right")
    for name in dict.fromkeys(trial["case"] for trial in trials):
        own = [trial for trial in trials if trial["case"] == name]
        shown.add_row(name, *(_cell([trial[key] for trial in own], form) for key, (_, form) in COLUMNS.items()))
    return shown


def _cell(values: Sequence[float | None], form: str) -> str:
    known = [value for value in values if value is not None]
    return form.format(median(known)) if known else ""


def _parser(cases: Mapping[str, Case]) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="bench uncertainty", description=__doc__)
    parser.add_argument(
        "--cases", nargs="+", choices=cases, default=list(cases), metavar="CASE", help=f"of {', '.join(cases)}"
    )
    parser.add_argument("--repeat", type=positive, default=1, metavar="N", help="scans of each case (default: 1)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all numbers; an older file is replaced")
    parser.add_argument(
        "--picture", type=Path, metavar="FILE", help="draw a case of those run (PNG); an older file is replaced"
    )
    parser.add_argument(
        "--pictured", choices=cases, default=PICTURED, metavar="CASE", help=f"which (default: {PICTURED})"
    )
    return parser
