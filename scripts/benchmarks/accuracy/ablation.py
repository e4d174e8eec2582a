"""The default fit without one of its parts at a time: what each part does to the mean and the largest distance."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

from rich.console import Console
from rich.table import Table

from benchmarks.accuracy.cases import GROUPS, chosen_cases
from benchmarks.accuracy.comparison import Protocol, run_case
from benchmarks.accuracy.parts import PARTS
from benchmarks.accuracy.problem import Problem
from benchmarks.harness import command_line
from benchmarks.harness.tables import row_table
from gnrecon.runtime.errors import ExitCode

WHOLE = "whole fit"


def main(arguments: Sequence[str], protocol: Protocol | None = None) -> int:
    """Run the benchmark with arguments; return the exit code, that of a batch with failures if a fit failed.

    It raises the errors of `many_scans.main`.
    """
    chosen = _parser().parse_args(arguments)
    protocol = (protocol or Protocol(threads=1, limit=3600.0)).at_quality(chosen.quality)
    command_line.require_folders(chosen.json)
    problems = {name: case.problem(chosen.data, 0) for name, case in chosen_cases(chosen.cases, GROUPS).items()}
    report: dict[str, Any] = command_line.provenance("ablation", arguments)
    report |= {"protocol": asdict(protocol), "cases": []}
    for name, problem in problems.items():
        report["cases"].append(ablated(name, problem, chosen.without, protocol))
        command_line.write_report(chosen.json, command_line.without_folders(report))
    Console(highlight=False, width=200).print(ablation_table(report["cases"]))
    failed = any("error" in one for case in report["cases"] for one in case["fits"].values())
    return ExitCode.BATCH if failed else ExitCode.OK


def ablated(name: str, problem: Problem, parts: Sequence[str], protocol: Protocol) -> dict[str, Any]:
    """Return the figures of the whole fit of a case, and of those without each part, by the part's name."""
    fits: dict[str, Any] = {}
    with command_line.scratch_folder() as folder:
        for number, part in enumerate([None, *parts]):
            options = protocol.options if part is None else protocol.options | {"without": part}
            told = replace(protocol, options=options)
            (fits[part or WHOLE],) = run_case(name, lambda _: problem, [0], ["gnrecon"], told, folder / str(number))
    return {"case": name, "unit": problem.unit, "factor": problem.factor, "fits": fits}


def ablation_table(cases: Sequence[Mapping[str, Any]]) -> Table:
    """Return a table with a row for each case: mean and largest distance of the whole, and their ratios without a part.

    A fit that does not use a part is the same without it: its cell is empty.
    """
    parts = [part for part in cases[0]["fits"] if part != WHOLE] if cases else []
    rows = [
        [case["case"], _distances(case), *(_ratios(case["fits"][WHOLE], case["fits"][part]) for part in parts)]
        for case in cases
    ]
    title = "Mean and largest distance, and their multiples without a part"
    return row_table(["", WHOLE, *parts], rows, title=title)


def _distances(case: Mapping[str, Any]) -> str:
    whole, factor = case["fits"][WHOLE], case["factor"]
    return "failed" if "error" in whole else f"{factor * whole['chamfer_mean']:.3f} / {factor * whole['hausdorff']:.1f}"


def _ratios(whole: Mapping[str, Any], part: Mapping[str, Any]) -> str:
    if "error" in whole or "error" in part:
        return "failed" if "error" in part else "-"
    pairs = [(part[key], whole[key]) for key in ("chamfer_mean", "hausdorff")]
    return "" if all(a == b for a, b in pairs) else " / ".join(f"{a / b:.2f}" for a, b in pairs)


def _parser() -> argparse.ArgumentParser:
    parser = command_line.benchmark_parser("ablation", __doc__)
    command_line.add_data(parser, "paper/, srb/, vipss500/ and organic/; the analytic cases need none")
    parser.add_argument("--cases", nargs="+", default=["analytic"], metavar="CASE", help="as those of bench accuracy")
    parser.add_argument(
        "--without",
        nargs="+",
        choices=PARTS,
        default=list(PARTS),
        metavar="PART",
        help=f"of {', '.join(PARTS)}; default: each",
    )
    command_line.add_quality(parser)
    command_line.add_outputs(parser)
    return parser
