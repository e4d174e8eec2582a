"""Estimated normals: the share on the right side, and the accuracy of the meshes made with them."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.accuracy.cases import GROUPS, Within, chosen_cases
from benchmarks.accuracy.comparison import Protocol, run_case
from benchmarks.accuracy.methods import oriented
from benchmarks.accuracy.problem import Case, Problem
from benchmarks.accuracy.scans import AnalyticScan, RangeScan
from benchmarks.accuracy.summary import summarise
from benchmarks.harness import command_line
from benchmarks.harness.measurement import Stopwatch
from benchmarks.harness.tables import number_or_dash, row_table
from gnrecon.export.metrics import SurfaceQuery
from gnrecon.geometry.arrays import Float, Int
from gnrecon.geometry.mesh import Mesh
from gnrecon.ingest import oriented_normals
from gnrecon.runtime.errors import ExitCode


def main(arguments: Sequence[str], protocol: Protocol | None = None) -> int:
    """Run the benchmark with arguments; return the exit code, that of a batch with failures if gnrecon made no mesh.

    It raises the errors of `many_scans.main`.
    """
    chosen = _parser().parse_args(arguments)
    protocol = (protocol or Protocol(limit=3600.0)).at_quality(chosen.quality)
    command_line.require_folders(chosen.json)
    problems = {
        name: case.problem(chosen.data, 0) for name, case in chosen_cases(chosen.cases, ORIENTATION_GROUPS).items()
    }
    report: dict[str, Any] = command_line.provenance("orient", arguments) | {"cases": []}
    for name, problem in problems.items():
        found = {"case": name} | sides(problem)
        if chosen.fits:
            found |= {"unit": problem.unit, "factor": problem.factor, "meshes": _meshes(name, problem, protocol)}
        report["cases"].append(found)
        command_line.write_report(chosen.json, report)
    console = Console(highlight=False, width=160)
    console.print(sides_table(report["cases"]))
    if chosen.fits:
        console.print(meshes_table(report["cases"]))
    failed = any("error" in one for found in report["cases"] for one in found.get("meshes", {}).values())
    return ExitCode.BATCH if failed else ExitCode.OK


def _meshes(name: str, problem: Problem, protocol: Protocol) -> dict[str, Any]:
    """Return the figures of meshes of a scan: by both methods without its normals, and by gnrecon with them."""
    unoriented = replace(problem, scan=problem.scan.with_normals(None))
    with command_line.scratch_folder() as folder:
        trials = run_case(name, lambda _: unoriented, [0], ["gnrecon", "Poisson"], protocol, folder / "unoriented")
        methods = summarise(trials, unoriented)["methods"]
        if problem.scan.normals is not None:
            trials = run_case(name, lambda _: problem, [0], ["gnrecon"], protocol, folder / "given")
            methods["given"] = summarise(trials, problem)["methods"]["gnrecon"]
    found: dict[str, Any] = command_line.without_folders(methods)
    return found


def sides_table(cases: Sequence[dict[str, Any]]) -> Table:
    """Return the shares of normals on the right side, a line per case."""
    rows = []
    for one in cases:
        ours, theirs = one["gnrecon"], one["open3d"]
        shares = [number_or_dash(figures["right"], "{:.2%}") for figures in (ours, theirs)]
        angles = [number_or_dash(figures["angle_mean"], "{:.1f}") for figures in (ours, theirs)]
        times = [f"{figures['cpu_seconds']:.1f}" for figures in (ours, theirs)]
        rows.append((one["case"], f"{one['points']:,}", *shares, *angles, f"{one['confidence']:.0%}", *times))
    headings = ("case", "points", "right side", "open3d", "degrees off", "open3d", "confirmed", "s", "open3d")
    caption = "open3d: 16 neighbours, tangent planes along a spanning tree; its better side counts."
    return row_table(headings, rows, caption=caption)


def meshes_table(cases: Sequence[dict[str, Any]]) -> Table:
    """Return the mean distances of the meshes, a line per case."""
    rows = []
    for one in cases:
        meshes, factor = one["meshes"], one["factor"]
        means = [meshes.get(name, {}).get("chamfer_mean") for name in ("gnrecon", "Poisson", "given")]
        ours, theirs, given = (None if mean is None else factor * mean for mean in means)
        parts = number_or_dash(meshes["gnrecon"].get("components"), "{:g}")
        distances = [number_or_dash(mean, "{:.3f}") for mean in (ours, theirs, given)]
        cells = [distances[0], parts, distances[1], _ratio(ours, theirs), distances[2], _ratio(ours, given)]
        rows.append((f"{one['case']}, {one['unit']}", *cells))
    headings = ("case", "gnrecon", "parts", "Poisson", "ratio", "with normals", "ratio")
    caption = "Mean distance, half the sum of both ways. Poisson: open3d's normals, its best depth."
    return row_table(headings, rows, caption=caption)


def _ratio(ours: float | None, other: float | None) -> str:
    return "-" if ours is None or not other else f"{ours / other:.2f}"


def _parser() -> argparse.ArgumentParser:
    parser = command_line.benchmark_parser("orient", __doc__)
    command_line.add_data(parser, "vipss500/, real/ and srb/")
    parser.add_argument(
        "--cases",
        nargs="+",
        default=list(ORIENTATION_GROUPS),
        metavar="CASE",
        help="groups (files, analytic) or cases; all",
    )
    parser.add_argument("--fits", action="store_true", help="also make the meshes: minutes for each large scan")
    command_line.add_quality(parser)
    command_line.add_outputs(parser)
    return parser


def true_normals(problem: Problem) -> Float | None:
    """Return the outward unit normals of a scan: its own, or the nearest true surface's; None if there is neither."""
    normals = problem.scan.normals
    if normals is None and isinstance(problem.truth, Mesh):
        _, faces = SurfaceQuery(problem.truth).nearest(problem.scan.points)
        normals = problem.truth.face_vectors[faces]
    return None if normals is None else normals / np.linalg.norm(normals, axis=1, keepdims=True)


def sides(problem: Problem) -> dict[str, Any]:
    """Return the figures of both estimates; those that need the truth are None without one."""
    truth = true_normals(problem)
    points, first = np.unique(problem.scan.points, axis=0, return_index=True)
    confidence = 0.0

    def ours() -> Float:
        nonlocal confidence
        found = oriented_normals(points)
        confidence = found.confidence or 0.0
        return found.normals

    def theirs() -> Float:
        return np.asarray(oriented(points, None, outliers=False).normals)

    figures = {name: _figures(method, truth, first) for name, method in (("gnrecon", ours), ("open3d", theirs))}
    return {"points": len(points), **figures, "confidence": confidence}


def _figures(estimate: Callable[[], Float], truth: Float | None, rows: Int) -> dict[str, Any]:
    with Stopwatch() as watch:
        normals = estimate()
    seconds = watch.cpu_seconds
    if truth is None:
        return {"right": None, "angle_mean": None, "cpu_seconds": seconds}
    cosines = np.einsum("ij,ij->i", normals, truth[rows])
    # open3d chooses the side of the whole at random; a user would notice and flip it.
    right = float(max((cosines > 0).mean(), (cosines < 0).mean()))
    angles = np.degrees(np.arccos(np.clip(np.abs(cosines), 0, 1)))
    return {"right": right, "angle_mean": float(angles.mean()), "cpu_seconds": seconds}


# If a scan has normals, they are the truth, and are removed.
ORIENTATION_GROUPS: dict[str, dict[str, Case]] = {
    "files": {
        **GROUPS["vipss"],
        "doghead": Within("real", RangeScan("doghead_unoriented.xyz")),
        **{name: GROUPS["srb"][name] for name in ("anchor", "daratech", "gargoyle")},
    },
    "analytic": {
        "torus, 400 points": AnalyticScan("torus", 400),
        "plate, 500 points": AnalyticScan("plate", 500),
        "block, 600 points": AnalyticScan("block", 600),
        "gear, 1500 points": AnalyticScan("gear", 1500),
        "gyroid, 1500 points": AnalyticScan("gyroid", 1500),
        "plate, 4000 points": AnalyticScan("plate", 4000),
        "block, 6000 points": AnalyticScan("block", 6000),
        "gear, noise 0.5%": AnalyticScan("gear", 10_000, noise=0.005),
        "gyroid, noise 1%": AnalyticScan("gyroid", 10_000, noise=0.01),
        "torus, uneven": AnalyticScan("torus", 1000, uneven=30.0),
        "block, hole": AnalyticScan("block", 3000, hole=0.3),
    },
}
