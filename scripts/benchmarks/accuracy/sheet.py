"""The contact sheet of an accuracy benchmark: a row a case, a column a method."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from benchmarks.accuracy.table import method_title
from benchmarks.arrays import load_mesh, load_scan, load_truth
from benchmarks.problem import Problem
from benchmarks.sheet import Part, Row
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import PointCloud

PANEL = (300, 270)
"""Width and height of a panel, in pixels."""

CROWD = 20_000
"""Most points that are drawn: more of them cover the panel, and take their time."""


def sheet_row(summary: dict[str, Any], problem: Problem, folder: Path) -> Row:
    """Return a case's row: the scan, each method's mesh of the first seed, and the truth; its files lie in `folder`."""
    points, normals = load_scan(folder / "scan-0.npz")
    some = slice(None, None, -(-len(points) // CROWD))
    scan = PointCloud(points[some], None if normals is None else normals[some])
    parts: dict[str, Part] = {summary["case"]: scan}
    for method, figures in summary["methods"].items():
        failed = "error" in figures
        title = f"{method}: failed" if failed else _title(method, figures, summary["factor"])
        parts[title] = figures["error"] if failed else load_mesh(Path(figures["folder"]) / "mesh.npz")
    truth = load_truth(folder / "truth.npz")
    parts["truth"] = truth if isinstance(truth, Mesh) else "There is no true surface; the scan stands for it."
    return Row(parts, problem.up, problem.view)


def _title(method: str, figures: dict[str, Any], factor: float) -> str:
    unsound = "open" if figures["closed"] < 1 else "no manifold"
    shape = unsound if figures["genus"] is None else f"genus {figures['genus']:g}"
    return f"{method_title(method, figures)}: {factor * figures['chamfer_mean']:.2f}, {shape}"
