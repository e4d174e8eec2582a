"""Large scans streamed through voxel thinning: points per second and peak memory, each format in its own process."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.harness import command_line
from benchmarks.harness.measurement import Stopwatch, run_isolated
from benchmarks.harness.tables import Figure, column_table
from gnrecon.geometry.arrays import Float
from gnrecon.io import IOParameters, read_scans
from gnrecon.io.parse import format_rows
from gnrecon.runtime.errors import ExitCode, UsageError

FIGURES = (
    Figure("bytes", "size of the file, MB", factor=1e-6),
    Figure("kept", "points kept"),
    Figure("seconds", "seconds", "{:.1f}"),
    Figure("cpu_seconds", "of processor time", "{:.1f}"),
    Figure("points_per_second", "million points a second", "{:.2f}", 1e-6),
    Figure("points_per_cpu_second", "a second of processor time", "{:.2f}", 1e-6),
    Figure("peak_memory_mb", "peak memory, MB"),
)


def main(arguments: Sequence[str]) -> int:
    """Run the benchmark with arguments; return the exit code, that of a batch where a measurement failed.

    Raises
    ------
    UsageError
        When a number is not positive.
    OutputError
        When the result cannot be written.
    """
    chosen = _parser().parse_args(arguments)
    if chosen.points < 1 or chosen.keep < 1:
        raise UsageError("The numbers of points and of those to keep must be positive.")
    command_line.require_folders(chosen.json)
    report: dict[str, Any] = command_line.provenance("ingest", arguments) | {"points": chosen.points, "scans": []}
    console = Console(highlight=False)
    for name in chosen.formats:
        console.print(f"bench: {chosen.points:,} points as {name}", style="dim")
        report["scans"].append({"format": name} | _measure(name, chosen))
    command_line.write_report(chosen.json, report)
    console.print(table(report["scans"]))
    return ExitCode.BATCH if any("error" in one for one in report["scans"]) else ExitCode.OK


def table(scans: Sequence[dict[str, Any]]) -> Table:
    """Return the figures, a column per format."""
    caption = "Each format in a process of its own; memory includes Python and the libraries."
    return column_table(scans, [one["format"] for one in scans], FIGURES, "", caption)


def _measure(name: str, chosen: argparse.Namespace) -> dict[str, Any]:
    with command_line.scratch_folder() as folder:
        scan = folder / f"scan.{name}"
        WRITERS[name](scan, chosen.points)
        arguments = {"scan": str(scan), "most": chosen.keep}
        return run_isolated("benchmarks.streamed_reading:measure_reading", arguments, folder / "measured")


def _parser() -> argparse.ArgumentParser:
    parser = command_line.benchmark_parser("ingest", __doc__)
    parser.add_argument("--points", type=int, default=20_000_000, help="points in each file")
    parser.add_argument(
        "--keep", type=int, default=IOParameters.most_points, help="points to keep, as of --read-points"
    )
    parser.add_argument("--formats", nargs="+", choices=list(WRITERS), default=list(WRITERS), help="formats to read")
    command_line.add_outputs(parser)
    return parser


def measure_reading(scan: str, most: int) -> dict[str, Any]:
    """Read a scan, keep at most `most` of its points, and return the figures."""
    with Stopwatch() as watch:
        cloud, reading = read_scans([scan], most=most)
    return {
        "points": reading.points,
        "kept": len(cloud),
        "side": reading.side,
        "bytes": Path(scan).stat().st_size,
        "seconds": watch.seconds,
        "cpu_seconds": watch.cpu_seconds,
        "points_per_second": reading.points / watch.seconds,
        "points_per_cpu_second": reading.points / watch.cpu_seconds,
    }


def corner() -> Float:
    """Return the projected coordinates of the scans' middle, in metres."""
    return np.array([431_000.0, 5_412_000.0, 300.0])


def blocks(count: int, *, most_points: int = 1_000_000) -> Iterator[Float]:
    """Yield `count` points of a wavy torus in metres, rounded to millimetres.

    A block has at most `most_points`; the points are the same every time.
    """
    rng = np.random.default_rng(0)
    for start in range(0, count, most_points):
        u, v = rng.uniform(0, 2 * np.pi, (2, min(most_points, count - start)))
        tube = 3 + 0.2 * np.sin(9 * u)
        points = np.column_stack(
            [(10 + tube * np.cos(v)) * np.cos(u), (10 + tube * np.cos(v)) * np.sin(u), tube * np.sin(v)]
        )
        yield np.round((points + corner()) / 1e-3) * 1e-3


def write_ply(path: Path, count: int) -> None:
    """Write a binary PLY file of doubles."""
    axes = "".join(f"property double {axis}\n" for axis in "xyz")
    with path.open("wb") as file:
        file.write(f"ply\nformat binary_little_endian 1.0\nelement vertex {count}\n{axes}end_header\n".encode())
        for block in blocks(count):
            file.write(block.astype("<f8").tobytes())


def write_las(path: Path, count: int) -> None:
    """Write point format 6 of LAS 1.4, in millimetres; compressed if the name ends with .laz."""
    import laspy

    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = np.full(3, 1e-3), corner()
    with laspy.open(path, mode="w", header=header) as file:
        for block in blocks(count):
            points = laspy.ScaleAwarePointRecord.zeros(len(block), header=header)
            points.x, points.y, points.z = block.T
            file.write_points(points)


def write_xyz(path: Path, count: int) -> None:
    """Write a line of x, y and z for each point."""
    with path.open("w", encoding="ascii") as file:
        for block in blocks(count):
            file.writelines(format_rows("%.3f %.3f %.3f\n", block))


WRITERS: dict[str, Callable[[Path, int], None]] = {
    "ply": write_ply,
    "las": write_las,
    "laz": write_las,
    "xyz": write_xyz,
}
