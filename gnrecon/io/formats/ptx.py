"""PTX, Leica's text format of gridded scans: one block for each position of the scanner, with its pose.

A block begins with the numbers of columns and of rows, the scanner's position and axes (four lines that repeat the
pose), and a 4 x 4 matrix that moves rows (x, y, z, 1) to common coordinates: its last row is where the scanner stood.
Then comes a line for each place of the grid, column by column: x, y, z in the scanner's own frame, intensity, and red,
green, blue where it saw colours. Where nothing came back, x, y and z are zero.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import IO

import numpy as np

from gnrecon.geometry.arrays import Float, Int, Values
from gnrecon.io.contents import Contents, joined, no_faces
from gnrecon.io.parse import numbers
from gnrecon.runtime.errors import InputError

_POSE_LINES = 8
_COLORS = slice(4, 7)
_ORTHOGONAL = 1e-3
"""Greatest departure of a pose's axes from a rotation with one scale."""


def read_ptx(path: Path) -> Contents:
    """Read all scans, in common coordinates, with the scanner's position and the place in its grid for each point.

    Raises
    ------
    InputError
        When a block is malformed or ends too early.
    """
    return joined(list(ptx_chunks(path, 1 << 20)))


def ptx_chunks(path: Path, rows: int) -> Iterator[Contents]:
    """Yield the points that came back, of at most `rows` places of a grid at a time.

    Raises
    ------
    InputError
        As `read_ptx` does.
    """
    with path.open("r", encoding="ascii", errors="replace") as file:
        number = 0
        while head := _next_line(file):
            number += 1
            columns, height = _size(head, number), _size(_next_line(file), number)
            matrix = _pose([_next_line(file) for _ in range(_POSE_LINES)], number)
            for start in range(0, columns * height, rows):
                count = min(rows, columns * height - start)
                table = _table(file, count, number)
                yield _contents(table, np.arange(start, start + count), height, matrix)


def _next_line(file: IO[str]) -> str:
    """The next line that is not blank, or nothing at the end."""
    return next((line for line in file if line.strip()), "")


def _size(line: str, number: int) -> int:
    if not line.strip().isdecimal():
        raise InputError(
            f"scan {number} begins with {line.strip()[:40]!r}, but a number of columns or rows was expected."
        )
    return int(line)


def _pose(lines: list[str], number: int) -> Float:
    """The 4 x 4 matrix, of the last four of eight lines."""
    rows = [numbers(line.split()) for line in lines]
    if [len(row) for row in rows] != [3, 3, 3, 3, 4, 4, 4, 4]:
        raise InputError(f"scan {number} lacks the four lines of its position or the four of its matrix.")
    matrix = np.stack(rows[4:])
    square = matrix[:3, :3] @ matrix[:3, :3].T
    scale = float(np.trace(square)) / 3
    if not (scale > 0 and np.abs(square / scale - np.eye(3)).max() <= _ORTHOGONAL and np.isfinite(matrix).all()):
        raise InputError(f"the matrix of scan {number} is no pose: its axes are not orthogonal and of one length.")
    return matrix


def _table(file: IO[str], count: int, number: int) -> Float:
    """The next `count` rows, of shape (count, 4 or 7)."""
    lines = list(islice(file, count))
    if len(lines) < count or not lines[-1].strip():
        raise InputError(f"scan {number} ends before the points that its grid has.")
    try:
        table = np.loadtxt(lines, dtype=np.float64, ndmin=2, comments=None)
    except ValueError as error:
        raise InputError(f"a row of scan {number} is not a row of numbers ({str(error).partition(';')[0]}).") from None
    if len(table) != count or table.shape[1] not in (4, 7):
        raise InputError(f"the rows of scan {number} are not those of a grid: 4 or 7 numbers in each were expected.")
    return table


def _contents(table: Float, places: Int, height: int, matrix: Float) -> Contents:
    seen = (table[:, :3] != 0).any(axis=1)
    table, places = table[seen], places[seen]
    attributes: dict[str, Values] = {"intensity": table[:, 3]}
    if table.shape[1] == 7:
        attributes["colors"] = np.clip(np.nan_to_num(table[:, _COLORS]), 0, 255).astype(np.uint8)
    attributes |= {"row": (places % height).astype(np.int32), "column": (places // height).astype(np.int32)}
    points = table[:, :3] @ matrix[:3, :3] + matrix[3, :3]
    origins = np.broadcast_to(matrix[3, :3], points.shape)
    return Contents(points, None, no_faces(), attributes, (), origins)
