"""gnrecon beside its peers, on scans of known surfaces, clean, noisy, sparse and faulty, in one run."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from rich.console import Console

from benchmarks.accuracy.cases import CASES, GROUPS
from benchmarks.accuracy.sheet import PANEL, sheet_row
from benchmarks.accuracy.summary import standing, summarise
from benchmarks.accuracy.table import accuracy_table, failures
from benchmarks.comparison import Protocol, problems_of, run_case
from benchmarks.groups import chosen_cases
from benchmarks.methods import METHODS
from benchmarks.paper import lasting, positive, require_folders
from benchmarks.problem import Case
from benchmarks.provenance import REPOSITORY, provenance
from benchmarks.sheet import Pixels, draw_row, write_sheet
from gnrecon.runtime.errors import ExitCode
from gnrecon.runtime.files import write_text

DATA = REPOSITORY.parent / "shared/data"
LIMIT = 3600.0
"""Seconds after which a trial counts as failed."""

WIDTH = 200
"""Of the table, in characters: a terminal that is narrower would break its numbers."""


def main(arguments: Sequence[str], protocol: Protocol | None = None) -> int:
    """Run the benchmark as the arguments say; return the exit code, that of a batch with failures if gnrecon failed.

    Raises
    ------
    InputError
        When a case's file is missing or cannot be read.
    OutputError
        When a result cannot be written.
    UsageError
        When a case or the quality is unknown.
    """
    chosen = _parser().parse_args(arguments)
    protocol = (protocol or Protocol(limit=LIMIT)).at_quality(chosen.quality)
    require_folders(chosen.json, chosen.picture)
    cases = chosen_cases(chosen.cases, GROUPS)
    for case in cases.values():
        case.problem(chosen.data, 0)  # a missing file is to be told now, not after the cases before it
    report = provenance("accuracy", arguments)
    report |= {"protocol": asdict(protocol), "seeds": list(range(chosen.repeat)), "summary": [], "trials": []}
    console = Console(highlight=False, width=WIDTH)
    rows: list[Pixels] = []
    for name, case in cases.items():
        rows += _run(name, case, chosen, protocol, report)
        # After each case, because the next may be stopped.
        if chosen.json:
            write_text(chosen.json, json.dumps(_written(report), indent=2) + "\n", overwrite=True)
        if chosen.picture:
            write_sheet(rows, chosen.picture)
    console.print(accuracy_table(report["summary"], chosen.repeat))
    place = standing(report["summary"])
    for sentence in [*failures(report["summary"]), *([] if place is None else [place.describe()])]:
        console.print(sentence, soft_wrap=True, markup=False)
    failed = any("error" in summary["methods"].get("gnrecon", {}) for summary in report["summary"])
    return ExitCode.BATCH if failed else ExitCode.OK


def _run(name: str, case: Case, chosen: argparse.Namespace, protocol: Protocol, report: dict[str, Any]) -> list[Pixels]:
    """Run a case and add its trials and their summary to the report; return its row of the sheet, if one is wanted."""
    problem_of = problems_of(case, chosen.data)
    problem = problem_of(0)
    with TemporaryDirectory(prefix="gnrecon-bench-") as temporary:
        folder = Path(temporary) / "case"
        trials = run_case(name, problem_of, report["seeds"], chosen.methods, protocol, folder)
        summary = summarise(trials, problem)
        report["trials"] += trials
        report["summary"].append(summary)
        return [draw_row(sheet_row(summary, problem, folder), PANEL)] if chosen.picture else []


def _written(report: dict[str, Any]) -> dict[str, Any]:
    """Return the report as it is written, with the standing and without names of temporary folders."""
    place = standing(report["summary"])
    lasting_parts = {key: lasting(report[key]) for key in ("summary", "trials")}
    return report | lasting_parts | {"standing": None if place is None else asdict(place)}


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="bench accuracy", description=__doc__)
    parser.add_argument(
        "--data",
        type=Path,
        default=DATA,
        metavar="DIR",
        help="folder of paper/, srb/ and vipss500/; the analytic cases need none",
    )
    parser.add_argument(
        "--cases",
        nargs="+",
        default=list(GROUPS),
        metavar="CASE",
        help=f"groups ({', '.join(GROUPS)}) or single cases ({', '.join(CASES)}); default: all".replace("%", "%%"),
    )
    parser.add_argument(
        "--methods",
        nargs="+",
        choices=METHODS,
        default=list(METHODS),
        metavar="METHOD",
        help=f"of {', '.join(METHODS)}; default: all",
    )
    parser.add_argument("--quality", metavar="NAME", help="gnrecon's own dial between time and accuracy")
    parser.add_argument("--repeat", type=positive, default=1, metavar="N", help="scans of each case (default: 1)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all numbers; an older file is replaced")
    parser.add_argument(
        "--picture", type=Path, metavar="FILE", help="write a contact sheet (PNG); an older file is replaced"
    )
    return parser
