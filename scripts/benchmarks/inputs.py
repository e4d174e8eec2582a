"""Scans of the kinds that people have, and what gnrecon and screened Poisson make of them.

Open scenes, sheets, inconsistent normals, noise without normals, filled volumes and overlapping strips are made here,
with known surfaces; the cases of ``../shared/cases`` are added where they are present. Poisson is open3d's, of depth 8,
untrimmed; it gets the scan's normals, or where there are none those that open3d estimates and orients.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from benchmarks.accuracy.methods import load_poisson
from benchmarks.harness import command_line
from benchmarks.harness.measurement import timed
from benchmarks.harness.tables import number_or_dash, row_table
from gnrecon.export import verify
from gnrecon.export.metrics import nearest_on_surface
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.io import read_reference, read_scans
from gnrecon.pipeline import reconstruct
from gnrecon.runtime.errors import ExitCode, GnreconError


@dataclass(frozen=True)
class KnownScan:
    """A scan, and points of the true surface; without any, distances are those of the scan's own points."""

    cloud: PointCloud
    truth: Float | None = None


def ball(count: int, rng: np.random.Generator) -> Float:
    """Return random points of the unit sphere, of shape (N, 3)."""
    points = rng.normal(size=(count, 3))
    return np.asarray(points / np.linalg.norm(points, axis=1, keepdims=True))


def torus(count: int, rng: np.random.Generator, minor: float = 0.4) -> tuple[Float, Float]:
    """Return random points of a torus of radius 1, and outward normals."""
    u, v = rng.uniform(0, 2 * np.pi, (2, count))
    normals = np.column_stack([np.cos(v) * np.cos(u), np.cos(v) * np.sin(u), np.sin(v)])
    return minor * normals + np.column_stack([np.cos(u), np.sin(u), np.zeros(count)]), normals


def scene(count: int, rng: np.random.Generator) -> Float:
    """Return points of a ball on a plate, as seen from above."""
    seen = 1.2 * ball(count // 3, rng) + [-2, 0, 1.2]
    plate = np.column_stack([rng.uniform(-5, 5, (count, 2)), np.zeros(count)])
    plate = plate[np.hypot(plate[:, 0] + 2, plate[:, 1]) > 1.1]
    return np.concatenate([seen[seen[:, 2] > 0.8], plate])


def terrain(count: int, rng: np.random.Generator) -> Float:
    """Return points of a terrain, 10 wide."""
    x, y = rng.uniform(-5, 5, (2, count))
    return np.column_stack([x, y, np.sin(x) + np.cos(1.3 * y) + 0.3 * np.sin(3 * x + 2 * y)])


def rings(ratio: float, *, radius: float = 0.4, apart: float = 0.15) -> Float:
    """Return rings around the tube of a torus, with points denser along them by a ratio than the rings are apart."""
    v, u = np.meshgrid(np.arange(0, 2 * np.pi, apart / ratio / radius), np.arange(0, 2 * np.pi - apart / 2, apart))
    u, v = u.ravel(), v.ravel()
    out = 1 + radius * np.cos(v)
    return np.column_stack([out * np.cos(u), out * np.sin(u), radius * np.sin(v)])


def strips(count: int, rng: np.random.Generator) -> Float:
    """Return points of two overlapping flights over one terrain, in which some points come close together."""
    points = terrain(count, rng)
    left, right = points[points[:, 0] < 2], points[points[:, 0] > -1]
    common = points[(points[:, 0] > -1) & (points[:, 0] < 2)]
    own = terrain(count, rng)
    right = np.concatenate([right[right[:, 0] >= 2], own[(own[:, 0] > -1) & (own[:, 0] < 2)], common[::5] + 1e-4])
    return np.concatenate([left, right])


def _noisy(points: Float, deviation: float, rng: np.random.Generator) -> PointCloud:
    return PointCloud(points + deviation * rng.standard_normal(points.shape))


def _made(name: str, count: int) -> KnownScan:
    """Make one of the scans of `KINDS`, of about so many points."""
    rng = np.random.default_rng(0)
    points, normals = torus(count, rng)
    dense = torus(60_000, rng)[0]
    made: dict[str, Callable[[], KnownScan]] = {
        "objects on a plate": lambda: KnownScan(_noisy(scene(count, rng), 0.01, rng), scene(60_000, rng)),
        "terrain": lambda: KnownScan(_noisy(terrain(count, rng), 0.01, rng), terrain(60_000, rng)),
        "overlapping strips": lambda: KnownScan(_noisy(strips(3 * count // 4, rng), 0.0, rng), terrain(60_000, rng)),
        "normals half turned": lambda: KnownScan(
            PointCloud(points, normals * rng.choice([-1.0, 1.0], (count, 1))), dense
        ),
        "noise, no normals": lambda: KnownScan(_noisy(points, 0.013, rng), dense),
        "points along lines": lambda: KnownScan(_noisy(rings(count / 500), 0.002, rng), dense),
        "filled volume": lambda: KnownScan(
            PointCloud(ball(count, rng) * rng.random((count, 1)) ** (1 / 3)), ball(60_000, rng)
        ),
    }
    return made[name]()


KINDS = (
    "objects on a plate",
    "terrain",
    "overlapping strips",
    "normals half turned",
    "noise, no normals",
    "points along lines",
    "filled volume",
)


def stored_case(folder: Path) -> KnownScan:
    """Read the scan and the truth of a folder."""
    cloud, _ = read_scans([next(folder.glob("scan.*"))])
    truth = folder / "truth.ply"
    return KnownScan(cloud, _sampled(read_reference(truth)) if truth.exists() else None)


def _sampled(shape: Mesh | PointCloud, count: int = 60_000) -> Float:
    """Return points of a shape: random ones of a mesh."""
    if isinstance(shape, PointCloud):
        return shape.points
    rng = np.random.default_rng(0)
    areas = np.linalg.norm(shape.face_vectors, axis=1)
    rows = rng.choice(len(areas), count, p=areas / areas.sum())
    shares = rng.dirichlet((1, 1, 1), count)
    return np.asarray(np.einsum("gk,gki->gi", shares, shape.vertices[shape.faces[rows]]))


def both_ways(mesh: Mesh, truth: Float) -> float:
    """Return the mean of the distances from the truth to a mesh and from the mesh to the truth."""
    from scipy.spatial import cKDTree

    there = float(nearest_on_surface(mesh, truth)[0].mean())
    back = float(cKDTree(truth).query(_sampled(mesh))[0].mean())
    return (there + back) / 2


def figures(scan: KnownScan, **options: Any) -> dict[str, Any]:
    """Return the figures of both methods for a scan; the options are those of `gnrecon.reconstruct`."""
    cloud = scan.cloud
    truth = cloud.points[np.isfinite(cloud.points).all(axis=1)] if scan.truth is None else scan.truth
    seconds, result = timed(lambda: reconstruct(cloud, **options))
    facts = verify(result.mesh)
    found: dict[str, Any] = {"points": len(cloud), "normals": result.report["ingest"]["normals"]}
    found["gnrecon"] = {
        "distance": both_ways(result.mesh, truth),
        "genus": facts.genus,
        "parts": facts.components,
        "closed": facts.closed,
        "seconds": seconds,
    }
    poisson, given = load_poisson(), cloud.normals if cloud.has_directions else None
    seconds, (mesh, _) = timed(lambda: poisson(cloud.points, given, depth=8, n_threads=1))
    found["Poisson"] = {"distance": both_ways(mesh, truth), "seconds": seconds}
    return found


def main(arguments: Sequence[str], **options: Any) -> int:
    """Run the benchmark with arguments; return the exit code, that of a batch with failures if gnrecon made no mesh.

    The options are those of `gnrecon.reconstruct`.
    """
    parser = command_line.benchmark_parser("inputs", __doc__)
    command_line.add_outputs(parser)
    stored = command_line.shared_data().parent / "cases"
    parser.add_argument("--data", type=Path, default=stored, metavar="DIR", help="folder of cases, a folder for each")
    command_line.add_quality(parser)
    parser.add_argument("--points", type=int, default=4000, metavar="N", help="of the scans that are made here")
    parser.add_argument("--cases", nargs="*", metavar="NAME", help="only those whose names begin so")
    chosen: argparse.Namespace = parser.parse_args(arguments)
    command_line.require_folders(chosen.json)
    folders = sorted(folder for folder in chosen.data.glob("[0-9]*") if any(folder.glob("scan.*")))
    scans: dict[str, Callable[[], KnownScan]] = {name: partial(_made, name, chosen.points) for name in KINDS}
    scans |= {folder.name: partial(stored_case, folder) for folder in folders}
    report: dict[str, Any] = command_line.provenance("inputs", arguments) | {"cases": []}
    for name, load in scans.items():
        if chosen.cases and not name.startswith(tuple(chosen.cases)):
            continue
        try:
            report["cases"].append({"case": name} | figures(load(), quality=chosen.quality or "normal", **options))
        except GnreconError as error:
            report["cases"].append({"case": name, "error": str(error)})
        command_line.write_report(chosen.json, report)
    rows = [_row(one) for one in report["cases"]]
    headings = ("case", "points", "gnrecon", "Poisson", "genus", "parts", "closed", "s")
    caption = "Mean distance between mesh and truth (or points), both ways, in file units."
    Console(highlight=False, width=140).print(row_table(headings, rows, caption=caption))
    return ExitCode.BATCH if any("error" in one for one in report["cases"]) else ExitCode.OK


def _row(one: dict[str, Any]) -> tuple[str, ...]:
    """Return a line of the table."""
    if "error" in one:
        return one["case"], "failed", *("-" for _ in range(6))
    ours, theirs = one["gnrecon"], one["Poisson"]
    genus = number_or_dash(ours["genus"] if ours["closed"] else None, "{}")
    distances = (f"{each['distance']:.4f}" for each in (ours, theirs))
    closed = "yes" if ours["closed"] else "open"
    return one["case"], f"{one['points']:,}", *distances, genus, f"{ours['parts']}", closed, f"{ours['seconds']:.0f}"
