"""PTX, Leica's text format of gridded scans: one block for each position of the scanner, with its pose.

A block begins with the numbers of columns and rows, the scanner's position and axes (four lines that repeat the pose),
and a 4 x 4 matrix that moves rows (x, y, z, 1) to common coordinates; its last row is the scanner's position. Then
comes a line for each grid cell, column by column: x, y, z in the scanner's frame, intensity, and red, green, blue where
the scanner recorded colours. Cells without a measurement have x = y = z = 0.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import IO

import numpy as np

from gnrecon.geometry.arrays import Float, Int, Values
from gnrecon.io.contents import Contents
from gnrecon.io.parse import parse_numbers
from gnrecon.runtime.errors import InputError


def ptx_chunks(path: Path, rows: int) -> Iterator[Contents]:
    """Yield the measured points of at most `rows` grid cells at a time, in common coordinates.

    Each point has the scanner's position and its grid cell.
    """
    with path.open("r", encoding="ascii", errors="replace") as file:
        number = 0
        while head := _next_line(file):
            number += 1
            columns, height = _size(head, number), _size(_next_line(file), number)
            matrix = _pose([_next_line(file) for _ in range(8)], number)
            for start in range(0, columns * height, rows):
                count = min(rows, columns * height - start)
                table = _table(file, count, number)
                yield _contents(table, np.arange(start, start + count), height, matrix)


def _next_line(file: IO[str]) -> str:
    """The next line that is not blank, or nothing at the end."""
    return next((line for line in file if line.strip()), "")


def _size(line: str, number: int) -> int:
    if not (word := line.strip()).isdecimal():
        raise InputError(f"scan {number} begins with {word[:40]!r}, but a number of columns or rows was expected.")
    return int(word)


def _pose(lines: list[str], number: int, *, tolerance: float = 1e-3) -> Float:
    """The 4 x 4 matrix in the last four of eight lines; its axes may differ from a scaled rotation by `tolerance`."""
    rows = [parse_numbers(line.split()) for line in lines]
    if [len(row) for row in rows] != [3, 3, 3, 3, 4, 4, 4, 4]:
        raise InputError(f"scan {number} lacks the four lines of its position or the four of its matrix.")
    matrix = np.stack(rows[4:])
    # For a rotation with one scale s, the product with the transpose is s^2 times the identity.
    square = matrix[:3, :3] @ matrix[:3, :3].T
    scale = float(np.trace(square)) / 3
    if not (scale > 0 and np.abs(square / scale - np.eye(3)).max() <= tolerance and np.isfinite(matrix).all()):
        raise InputError(f"the matrix of scan {number} is not a pose: its axes are not orthogonal and of equal length.")
    return matrix


def _table(file: IO[str], count: int, number: int) -> Float:
    """The next `count` rows, of shape (count, 4 or 7)."""
    lines = list(islice(file, count))
    if len(lines) < count or not lines[-1].strip():
        raise InputError(f"scan {number} ends before all points of its grid.")
    try:
        table = np.loadtxt(lines, dtype=np.float64, ndmin=2, comments=None)
    except ValueError as error:
        raise InputError(f"a row of scan {number} is not a row of numbers ({str(error).partition(';')[0]}).") from None
    if len(table) != count or table.shape[1] not in (4, 7):
        raise InputError(f"the rows of scan {number} are not those of a grid: 4 or 7 numbers in each were expected.")
    return table


def _contents(table: Float, cells: Int, height: int, matrix: Float) -> Contents:
    measured = (table[:, :3] != 0).any(axis=1)
    table, cells = table[measured], cells[measured]
    attributes: dict[str, Values] = {"intensity": table[:, 3]}
    if table.shape[1] == 7:
        attributes["colors"] = np.clip(np.nan_to_num(table[:, 4:7]), 0, 255).astype(np.uint8)
    # Cells are stored column by column, as the scanner turns.
    attributes |= {"row": (cells % height).astype(np.int32), "column": (cells // height).astype(np.int32)}
    found = Contents(table[:, :3], attributes=attributes)
    return found.moved(matrix[:3, :3].T, matrix[3, :3], matrix[3, :3])
