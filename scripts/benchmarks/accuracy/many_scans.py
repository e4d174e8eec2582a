"""gnrecon compared with its peers on scans of known surfaces: clean, noisy, sparse, faulty, organic and open."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console

from benchmarks.accuracy.cases import GROUPS, cases_of, chosen_cases, stored_name
from benchmarks.accuracy.comparison import Protocol, problems_of, run_case
from benchmarks.accuracy.methods import METHODS
from benchmarks.accuracy.problem import Case, Problem, load_mesh, load_scan, load_truth
from benchmarks.accuracy.stored_peers import StoredFigures, best_stored, read_stored, stored_standing
from benchmarks.accuracy.summary import accuracy_table, failures, method_title, standing, summarise
from benchmarks.harness import command_line
from benchmarks.harness.contact_sheet import Part, Pixels, Row, draw_row, write_sheet
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.ingest import flip_if_inward
from gnrecon.runtime.errors import ExitCode


def main(arguments: Sequence[str], protocol: Protocol | None = None) -> int:
    """Run the benchmark with arguments; return the exit code, that of a batch with failures if gnrecon failed.

    Raises
    ------
    InputError
        When a case's file or that of the stored figures is missing or cannot be read, or these are in another unit.
    OutputError
        When a result cannot be written.
    UsageError
        When a case or the quality is unknown.
    """
    chosen = _parser().parse_args(arguments)
    protocol = (protocol or Protocol(limit=3600.0)).at_quality(chosen.quality)
    command_line.require_folders(chosen.json, chosen.picture)
    cases = chosen_cases(chosen.cases, GROUPS)
    stored = {} if chosen.peers is None else read_stored(chosen.peers)
    for case in cases.values():
        # Fails now if a file is missing or stored figures do not fit, not after other cases.
        best_stored(stored_name(case), case.problem(chosen.data, 0), stored)
    report = command_line.provenance("accuracy", arguments)
    report |= {"protocol": asdict(protocol), "seeds": list(range(chosen.repeat)), "summary": [], "trials": []}
    # In a narrower terminal the numbers would be broken over lines.
    console = Console(highlight=False, width=200)
    rows: list[Pixels] = []
    for name, case in cases.items():
        rows += _run(name, case, chosen, protocol, report, stored)
        # After each case, so that an interrupted run keeps its results.
        command_line.write_report(chosen.json, _with_standing(report))
        if chosen.picture:
            write_sheet(rows, chosen.picture)
    console.print(accuracy_table(report["summary"], chosen.repeat))
    places = [standing(report["summary"]), stored_standing(report["summary"])]
    for sentence in [*failures(report["summary"]), *(place.describe() for place in places if place is not None)]:
        console.print(sentence, soft_wrap=True, markup=False)
    failed = any("error" in summary["methods"].get("gnrecon", {}) for summary in report["summary"])
    return ExitCode.BATCH if failed else ExitCode.OK


def _run(
    name: str,
    case: Case,
    chosen: argparse.Namespace,
    protocol: Protocol,
    report: dict[str, Any],
    stored: Mapping[str, Sequence[StoredFigures]],
) -> list[Pixels]:
    """Run a case and add its trials and their summary to the report; return its row of the sheet with --picture."""
    problem_of = problems_of(case, chosen.data)
    problem = problem_of(0)
    with command_line.scratch_folder() as scratch:
        folder = scratch / "case"
        trials = run_case(name, problem_of, report["seeds"], chosen.methods, protocol, folder)
        summary = summarise(trials, problem, best_stored(stored_name(case), problem, stored))
        report["trials"] += trials
        report["summary"].append(summary)
        return [draw_row(sheet_row(summary, problem, folder), (300, 270))] if chosen.picture else []


def _with_standing(report: dict[str, Any]) -> dict[str, Any]:
    """Return the report as it is written, with both standings and without names of temporary folders."""
    places = {"standing": standing(report["summary"]), "stored_standing": stored_standing(report["summary"])}
    found = {key: None if place is None else asdict(place) for key, place in places.items()}
    written: dict[str, Any] = command_line.without_folders(report | found)
    return written


def _parser() -> argparse.ArgumentParser:
    parser = command_line.benchmark_parser("accuracy", __doc__)
    command_line.add_data(parser, "paper/, srb/, vipss500/ and organic/; the analytic cases need none")
    parser.add_argument(
        "--cases",
        nargs="+",
        default=list(GROUPS),
        metavar="CASE",
        help=f"groups ({', '.join(GROUPS)}) or single cases ({', '.join(cases_of(GROUPS))}); default: all".replace(
            "%", "%%"
        ),
    )
    parser.add_argument(
        "--methods",
        nargs="+",
        choices=METHODS,
        default=list(METHODS),
        metavar="METHOD",
        help=f"of {', '.join(METHODS)}; default: all",
    )
    parser.add_argument(
        "--peers",
        type=Path,
        metavar="FILE",
        help="stored figures of other peers to show and to compare with (JSON lines)",
    )
    command_line.add_quality(parser)
    command_line.add_repeat(parser, "scans of each case")
    command_line.add_outputs(parser, picture="write a contact sheet")
    return parser


def sheet_row(summary: dict[str, Any], problem: Problem, folder: Path, *, most_points: int = 20_000) -> Row:
    """Return a case's row: the scan, each method's mesh of the first seed, and the truth; its files lie in `folder`.

    At most `most_points` of the scan are drawn: more of them would cover the panel. Meshes and normals that look inward
    are turned, because they would be drawn dark.
    """
    points, normals = load_scan(folder / "scan-0.npz")
    some = slice(None, None, -(-len(points) // most_points))
    points, normals = points[some], None if normals is None else normals[some]
    scan = PointCloud(points, None if normals is None else flip_if_inward(points, normals)[0])
    parts: dict[str, Part] = {summary["case"]: scan}
    for method, figures in summary["methods"].items():
        failed = "error" in figures
        title = f"{method}: failed" if failed else _title(method, figures, summary["factor"])
        parts[title] = figures["error"] if failed else _outward(load_mesh(Path(figures["folder"]) / "mesh.npz"))
    truth = load_truth(folder / "truth.npz")
    unknown = "There is no true surface; meshes are compared with the scan."
    parts["truth"] = _outward(truth) if isinstance(truth, Mesh) else unknown
    return Row(parts, problem.up, problem.view)


def _outward(mesh: Mesh) -> Mesh:
    return mesh if mesh.volume >= 0 else Mesh(mesh.vertices, mesh.faces[:, ::-1])


def _title(method: str, figures: dict[str, Any], factor: float) -> str:
    unsound = "open" if figures["closed"] < 1 else "no manifold"
    shape = unsound if figures["genus"] is None else f"genus {figures['genus']:g}"
    return f"{method_title(method, figures)}: {factor * figures['chamfer_mean']:.2f}, {shape}"
