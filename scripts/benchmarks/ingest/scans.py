"""Large scans to read: points on a wavy torus in projected coordinates, written block by block."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from gnrecon.geometry.arrays import Float
from gnrecon.io.parse import format_rows

BLOCK = 1_000_000
_CORNER = np.array([431_000.0, 5_412_000.0, 300.0])
_MILLIMETRE = 1e-3


def blocks(count: int) -> Iterator[Float]:
    """Yield `count` points in metres, whole millimetres each, at most `BLOCK` at a time and the same every time."""
    rng = np.random.default_rng(0)
    for start in range(0, count, BLOCK):
        u, v = rng.uniform(0, 2 * np.pi, (2, min(BLOCK, count - start)))
        tube = 3 + 0.2 * np.sin(9 * u)
        points = np.column_stack(
            [(10 + tube * np.cos(v)) * np.cos(u), (10 + tube * np.cos(v)) * np.sin(u), tube * np.sin(v)]
        )
        yield np.round((points + _CORNER) / _MILLIMETRE) * _MILLIMETRE


def write_ply(path: Path, count: int) -> None:
    """Binary, with doubles."""
    axes = "".join(f"property double {axis}\n" for axis in "xyz")
    with path.open("wb") as file:
        file.write(f"ply\nformat binary_little_endian 1.0\nelement vertex {count}\n{axes}end_header\n".encode())
        for block in blocks(count):
            file.write(block.astype("<f8").tobytes())


def write_las(path: Path, count: int) -> None:
    """Point format 6 of LAS 1.4, in millimetres; compressed where the file is called so."""
    import laspy

    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = np.full(3, _MILLIMETRE), _CORNER
    with laspy.open(path, mode="w", header=header) as file:
        for block in blocks(count):
            points = laspy.ScaleAwarePointRecord.zeros(len(block), header=header)
            points.x, points.y, points.z = block.T
            file.write_points(points)


def write_text(path: Path, count: int) -> None:
    """A line of x, y and z for each point."""
    with path.open("w", encoding="ascii") as file:
        for block in blocks(count):
            file.writelines(format_rows("%.3f %.3f %.3f\n", block))


WRITERS: dict[str, Callable[[Path, int], None]] = {
    "ply": write_ply,
    "las": write_las,
    "laz": write_las,
    "xyz": write_text,
}
