"""Normals found for clouds without any: on the right side or not, and what the meshes made with them are worth."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from rich.console import Console
from rich.table import Table

from benchmarks.accuracy.main import DATA, LIMIT
from benchmarks.accuracy.summary import summarise
from benchmarks.comparison import Protocol, run_case
from benchmarks.groups import chosen_cases
from benchmarks.orient.cases import GROUPS
from benchmarks.orient.sides import sides
from benchmarks.paper import lasting, require_folders
from benchmarks.problem import Problem
from benchmarks.provenance import provenance
from gnrecon.runtime.errors import ExitCode
from gnrecon.runtime.files import write_text

WIDTH = 160


def main(arguments: Sequence[str], protocol: Protocol | None = None) -> int:
    """Run the benchmark as the arguments say; return the exit code, that of a batch where gnrecon made no mesh.

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
    require_folders(chosen.json)
    problems = {name: case.problem(chosen.data, 0) for name, case in chosen_cases(chosen.cases, GROUPS).items()}
    report: dict[str, Any] = provenance("orient", arguments) | {"cases": []}
    for name, problem in problems.items():
        found = {"case": name} | sides(problem)
        if chosen.fits:
            found |= {"unit": problem.unit, "factor": problem.factor, "meshes": _meshes(name, problem, protocol)}
        report["cases"].append(found)
        if chosen.json:
            write_text(chosen.json, json.dumps(report, indent=2) + "\n", overwrite=True)
    console = Console(highlight=False, width=WIDTH)
    console.print(sides_table(report["cases"]))
    if chosen.fits:
        console.print(meshes_table(report["cases"]))
    failed = any("error" in one for found in report["cases"] for one in found.get("meshes", {}).values())
    return ExitCode.BATCH if failed else ExitCode.OK


def _meshes(name: str, problem: Problem, protocol: Protocol) -> dict[str, Any]:
    """Return what the meshes of a scan come to: without its normals by both methods, and with them by gnrecon."""
    bare = replace(problem, scan=problem.scan.with_normals(None))
    with TemporaryDirectory(prefix="gnrecon-bench-") as temporary:
        trials = run_case(name, lambda _: bare, [0], ["gnrecon", "Poisson"], protocol, Path(temporary) / "bare")
        methods = summarise(trials, bare)["methods"]
        if problem.scan.normals is not None:
            trials = run_case(name, lambda _: problem, [0], ["gnrecon"], protocol, Path(temporary) / "given")
            methods["given"] = summarise(trials, problem)["methods"]["gnrecon"]
    found: dict[str, Any] = lasting([{"methods": methods}])[0]["methods"]
    return found


def sides_table(cases: Sequence[dict[str, Any]]) -> Table:
    """Return the shares of normals on the right side, a line a case."""
    table = Table(caption="open3d: 16 neighbours, tangent planes along a spanning tree; its better side counts.")
    table.add_column("case", no_wrap=True)
    for heading in ("points", "right side", "open3d", "degrees off", "open3d", "confirmed", "s", "open3d"):
        table.add_column(heading, justify="right")
    for one in cases:
        ours, theirs = one["gnrecon"], one["open3d"]
        shares = [_told(figures["right"], "{:.2%}") for figures in (ours, theirs)]
        angles = [_told(figures["angle_mean"], "{:.1f}") for figures in (ours, theirs)]
        times = [f"{figures['cpu_seconds']:.1f}" for figures in (ours, theirs)]
        table.add_row(one["case"], f"{one['points']:,}", *shares, *angles, f"{one['confidence']:.0%}", *times)
    return table


def meshes_table(cases: Sequence[dict[str, Any]]) -> Table:
    """Return the mean distances of the meshes, a line a case."""
    table = Table(caption="Mean distance, half the sum of both ways. Poisson: open3d's normals, its best depth.")
    table.add_column("case", no_wrap=True)
    for heading in ("gnrecon", "parts", "Poisson", "ratio", "with normals", "ratio"):
        table.add_column(heading, justify="right")
    for one in cases:
        meshes, factor = one["meshes"], one["factor"]
        means = [meshes.get(name, {}).get("chamfer_mean") for name in ("gnrecon", "Poisson", "given")]
        ours, theirs, given = (None if mean is None else factor * mean for mean in means)
        parts = meshes["gnrecon"].get("components")
        cells = [_told(ours, "{:.3f}"), _told(parts, "{:g}"), _told(theirs, "{:.3f}"), _ratio(ours, theirs)]
        table.add_row(f"{one['case']}, {one['unit']}", *cells, _told(given, "{:.3f}"), _ratio(ours, given))
    return table


def _told(value: float | None, form: str) -> str:
    return "-" if value is None else form.format(value)


def _ratio(ours: float | None, other: float | None) -> str:
    return "-" if ours is None or not other else f"{ours / other:.2f}"


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="bench orient", description=__doc__)
    parser.add_argument("--data", type=Path, default=DATA, metavar="DIR", help="folder of vipss500/, real/ and srb/")
    parser.add_argument(
        "--cases", nargs="+", default=list(GROUPS), metavar="CASE", help="groups (files, analytic) or cases; all"
    )
    parser.add_argument("--fits", action="store_true", help="make the meshes, too: minutes for each large scan")
    parser.add_argument("--quality", metavar="NAME", help="gnrecon's own dial between time and accuracy")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all numbers; an older file is replaced")
    return parser
