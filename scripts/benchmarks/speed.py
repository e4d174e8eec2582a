"""Whole commands on growing scans: seconds, memory and distance from the truth, next to screened Poisson's.

Scans are those of a rippled ball, with noise and normals (`scaling_run.Ball`): one of more points is a larger ball at
the same spacing. With ``--surface MESH`` they are exact points of that mesh with the normals of its faces: a shape with
thin parts and detail of all sizes has a larger surface than a ball, and asks for more. Both methods are commands from
a scan's file to a mesh's, in processes of their own: gnrecon's is ``gnrecon SCAN -o MESH``, the other reads the scan,
calls open3d's Poisson, and writes the mesh. They take turns, so that both see the machine in the same state; times are
medians.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.accuracy.surface_scans import draw_surface
from benchmarks.harness import command_line
from benchmarks.harness.measurement import GNRECON, run_command
from benchmarks.harness.tables import Figure, row_table
from benchmarks.scaling_run import Ball
from gnrecon.export.metrics import nearest_on_surface
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.io import read_mesh, write_cloud
from gnrecon.runtime.errors import ExitCode, UsageError
from gnrecon.runtime.files import atomic_write

POISSON = """
import sys, open3d
cloud = open3d.io.read_point_cloud(sys.argv[1])
mesh, _ = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson(
    cloud, depth=int(sys.argv[3]), n_threads=int(sys.argv[4])
)
open3d.io.write_triangle_mesh(sys.argv[2], mesh)
"""

FIGURES = (
    Figure("seconds", "s", "{:.1f}"),
    Figure("cpu_seconds", "processor s", "{:.1f}"),
    Figure("peak_memory_mb", "MB"),
    Figure("faces", "faces", "{:,}"),
    Figure("mean", "mean distance", "{:.3f}"),
    Figure("largest", "largest", "{:.2f}"),
)


@dataclass(frozen=True)
class Surface:
    """The surface of a mesh, of one square unit for each of `points` points, with the methods of `Ball`."""

    points: int
    mesh: Mesh

    @classmethod
    def of(cls, mesh: Mesh, points: int) -> Surface:
        """Scale a mesh."""
        return cls(points, Mesh(mesh.vertices * (points / mesh.area) ** 0.5, mesh.faces))

    def scan(self, seed: int = 1, noisy: bool = False, count: int | None = None) -> PointCloud:
        """Return exact points, uniform by area, with the normals of their faces; by default as many as the scan has."""
        del noisy
        return PointCloud(*draw_surface(self.mesh, count or self.points, seed))

    def distances(self, x: Float) -> Float:
        """Return how far points, of shape (N, 3), lie from the surface, of shape (N,)."""
        return nearest_on_surface(self.mesh, x)[0]


def main(arguments: Sequence[str]) -> int:
    """Run the benchmark with arguments; return the exit code, that of a batch where a command failed.

    Raises
    ------
    UsageError
        When a scan is too small, or there is no matplotlib for the picture.
    InputError
        When the mesh cannot be read.
    OutputError
        When the result cannot be written.
    """
    parser = command_line.benchmark_parser("speed", __doc__)
    counts = (1000, 2000, 5000, 20_000, 100_000, 300_000, 1_000_000)
    parser.add_argument("--counts", nargs="+", type=int, default=counts, metavar="N", help="points of the scans")
    parser.add_argument("--surface", type=Path, metavar="MESH", help="a mesh to scan in place of the ball")
    parser.add_argument("--threads", type=command_line.positive, default=2, metavar="N", help="of both methods")
    parser.add_argument("--depth", type=command_line.positive, default=9, metavar="N", help="of Poisson's octree")
    parser.add_argument("options", nargs="*", metavar="-- OPTION", help="more options of gnrecon, after --")
    command_line.add_repeat(parser, "runs of each command, of which the medians count", 5)
    command_line.add_outputs(parser, picture="plot processor time against points")
    chosen = parser.parse_args(arguments)
    if min(chosen.counts) < 100:
        raise UsageError("A scan must have at least 100 points.")
    command_line.require_drawable(chosen.json, chosen.picture)
    surface = Ball if chosen.surface is None else partial(Surface.of, read_mesh(chosen.surface))
    console = Console(highlight=False, width=120)
    version = run_command([*GNRECON, "--version"], chosen.threads)
    report: dict[str, Any] = command_line.provenance("speed", arguments) | {"version": version, "scans": []}
    for count in sorted(chosen.counts):
        console.print(f"bench: {count:,} points", style="dim")
        report["scans"].append(_compared(surface(count), chosen))
        report["exponents"] = {name: exponent(report["scans"], name) for name in report["scans"][0]["methods"]}
        command_line.write_report(chosen.json, report)
    if chosen.picture:
        draw(report["scans"], chosen.picture)
    console.print(table(report))
    failed = any("error" in one for scan in report["scans"] for one in scan["methods"].values())
    return ExitCode.BATCH if failed else ExitCode.OK


def _compared(truth: Ball | Surface, chosen: argparse.Namespace) -> dict[str, Any]:
    """Return the figures of both methods on the scan of a surface."""
    threads = chosen.threads
    with command_line.scratch_folder() as folder:
        scan = folder / "scan.ply"
        write_cloud(truth.scan(), scan)
        meshes = {name: folder / f"{name}.ply" for name in ("gnrecon", "Poisson")}
        commands = {
            "gnrecon": [*GNRECON, scan, "-o", meshes["gnrecon"], "--overwrite", "--quiet", f"--threads={threads}"],
            "Poisson": [sys.executable, "-c", POISSON, scan, meshes["Poisson"], chosen.depth, threads],
        }
        commands["gnrecon"] += chosen.options
        runs: dict[str, list[dict[str, Any]]] = {name: [] for name in commands}
        for _ in range(chosen.repeat):
            for name, words in commands.items():
                runs[name].append(run_command([str(word) for word in words], threads))
        figures = {name: _figures(truth, runs[name], meshes[name]) for name in commands}
        return {"points": truth.points, "methods": figures}


def _figures(
    truth: Ball | Surface, runs: Sequence[dict[str, Any]], path: Path, *, samples: int = 20_000
) -> dict[str, Any]:
    """Return the medians of the runs, or the first error, and the distances of their mesh, in spacings.

    Both ways: from the mesh's vertices to the truth, and from samples of the truth to the mesh.
    """
    if errors := [run["error"] for run in runs if "error" in run]:
        return {"error": errors[0]}
    mesh = read_mesh(path)
    there = np.abs(truth.distances(mesh.vertices))
    back = nearest_on_surface(mesh, truth.scan(seed=2, noisy=False, count=samples).points)[0]
    return {
        **{key: median(run[key] for run in runs) for key in runs[0]},
        "runs": list(runs),
        "faces": len(mesh.faces),
        "mean": float(there.mean() + back.mean()) / 2,
        "largest": float(max(there.max(), back.max())),
    }


def exponent(scans: Sequence[dict[str, Any]], name: str, *, least_points: int = 10_000) -> float | None:
    """Return the b of a method's processor seconds in proportion to points^b, by least squares of the logarithms.

    Scans of fewer points, whose cost does not depend on them, are left out. It is None for fewer than two scans.
    """
    shown = [one for one in scans if one["points"] >= least_points and "error" not in one["methods"][name]]
    if len(shown) < 2:
        return None
    x = np.log([one["points"] for one in shown])
    return float(np.polyfit(x, np.log([one["methods"][name]["cpu_seconds"] for one in shown]), 1)[0])


def table(report: dict[str, Any]) -> Table:
    """Return the figures, a row for each scan and method."""
    rows = [
        (f"{scan['points']:,}", name, *(figure.cell(one) for figure in FIGURES))
        for scan in report["scans"]
        for name, one in scan["methods"].items()
    ]
    powers = [f"{name} {power:.2f}" for name, power in report["exponents"].items() if power is not None]
    caption = "Medians of whole commands; distances, both ways, in spacings of the points."
    if powers:
        caption += f" Exponents of processor time from 10,000 points on: {', '.join(powers)}."
    caption += f" gnrecon --version takes {report['version'].get('seconds', float('nan')):.2f} s."
    return row_table(("points", "method", *(figure.label for figure in FIGURES)), rows, caption=caption)


def draw(scans: Sequence[dict[str, Any]], path: Path) -> None:
    """Write a PNG file of processor seconds against points, for both methods; an older file is replaced.

    Raises
    ------
    OutputError
        When the file cannot be written.
    """
    from matplotlib.figure import Figure as Drawing

    drawing = Drawing(figsize=(6.4, 4.4), layout="constrained")
    axes = drawing.subplots()
    for name in scans[0]["methods"]:
        shown = [one for one in scans if "error" not in one["methods"][name]]
        seconds = [one["methods"][name]["cpu_seconds"] for one in shown]
        power = exponent(scans, name)
        label = name if power is None else f"{name}, exponent {power:.2f} from 10,000 on"
        axes.loglog([one["points"] for one in shown], seconds, marker="o", label=label)
    axes.set(xlabel="points", ylabel="seconds of processor time, whole command")
    axes.legend()
    axes.grid(alpha=0.3)
    with atomic_write(path, overwrite=True) as temporary:
        drawing.savefig(temporary, format="png", dpi=120)
