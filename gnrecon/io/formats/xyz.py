"""Columns of numbers in text: XYZ, PTS, TXT, CSV, separated by blanks, commas, semicolons or tabs; read and written.

Columns are named by a header line (``x,y,z,nx,ny,nz`` or ``//X Y Z Intensity``). Otherwise they are guessed from their
number: three that form unit vectors are normals, and the others are what scanners commonly write. A first line with a
single count, as in PTS files, is checked against the rows.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import IO

import numpy as np

from gnrecon.geometry.arrays import Float
from gnrecon.geometry.mesh import Mesh
from gnrecon.io.contents import Contents, from_columns
from gnrecon.io.formats.ply import vertex_columns
from gnrecon.io.parse import read_text
from gnrecon.runtime.errors import InputError


def read_xyz(path: Path) -> Contents:
    """Read a table of points.

    Raises
    ------
    InputError
        When a word is not a number, rows differ in length, a count line is wrong, or there are fewer than 3 columns.
    """
    names, count, body = split_head(read_text(path))
    rows = parse_table(body)
    if count is not None and len(rows) != count:
        raise InputError(f"the first line declares {count} points, but {len(rows)} follow.")
    return from_columns(dict(zip(column_names(names, rows), rows.T, strict=True)))


def column_names(names: list[str] | None, rows: Float) -> list[str]:
    """Return the names of the columns of a table of shape (N, C): those of its header, or guessed ones.

    Raises
    ------
    InputError
        When they do not fit the table, or there are fewer than 3 columns.
    """
    if rows.shape[1] < 3:
        raise InputError(f"expected at least 3 columns (x, y, z), but found {rows.shape[1]}.")
    names = _guess_names(rows) if names is None else names
    if len(names) != rows.shape[1]:
        raise InputError(f"the header names {len(names)} columns, but the rows hold {rows.shape[1]}.")
    return names


def _words(line: str) -> list[str]:
    return [word.strip("\"'") for word in re.split(r"[\s,;]+", line.strip()) if word]


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def split_head(text: str) -> tuple[list[str] | None, int | None, str]:
    """Return the column names and the count in the file's head, and the rows that follow.

    Raises
    ------
    InputError
        When there is neither a row of numbers nor a header.
    """
    names: list[str] | None = None
    start = 0
    for line in io.StringIO(text):
        stripped = line.strip()
        comment = stripped.startswith(("#", "//", ";", "%"))
        words = _words(stripped.lstrip("#/;%"))
        if words and not comment and all(map(_is_number, words)):
            # A line with a single whole number is the count of a PTS file.
            if len(words) == 1 and words[0].isdecimal():
                return names, int(words[0]), text[start + len(line) :]
            return names, None, text[start:]
        if {"x", "y", "z"} <= {word.lower() for word in words}:
            names = words
        elif stripped and not comment and (names or start):
            raise InputError(f"the line {stripped[:60]!r} holds no row of numbers.")
        elif stripped and not comment:
            raise InputError(f"the first line {stripped[:60]!r} holds neither numbers nor columns named x, y and z.")
        start += len(line)
    raise InputError("the file holds no points.")


def parse_table(body: str) -> Float:
    """Return the rows as an array of shape (N, columns).

    Raises
    ------
    InputError
        When there are none, a word is not a number, or rows differ in length.
    """
    first = body.lstrip().partition("\n")[0]
    if ";" in first and "," in first:
        body = body.replace(",", ".")  # a spreadsheet with decimal commas
    body = body.translate(str.maketrans(",;\t", "   "))
    if not body.strip():
        raise InputError("the file holds no points.")
    try:
        return np.loadtxt(io.StringIO(body), dtype=np.float64, comments=["#", "//"], ndmin=2)
    except ValueError as error:
        raise InputError(_row_error(str(error))) from None


def _row_error(message: str) -> str:
    """Return numpy's message about a row in terms of the file."""
    if found := re.search(r"could not convert string (.*?) to .*? at row (\d+)", message):
        return f"{found[1]} in row {int(found[2]) + 1} is not a number."
    if found := re.search(r"columns changed from (\d+) to (\d+) at row (\d+)", message):
        return f"row {found[3]} holds {found[2]} numbers, but the rows before it hold {found[1]}."
    return f"the rows are not a table of numbers ({message.partition(';')[0]})."


def _are_unit_vectors(vectors: Float, *, least_share: float = 0.9, tolerance: float = 0.05) -> bool:
    """Whether at least a share of the finite non-zero rows, of shape (N, 3), have unit length.

    The tolerance of the length is wide because some scanners store normals with two digits.
    """
    lengths = np.linalg.norm(vectors, axis=1)
    lengths = lengths[np.isfinite(lengths) & (lengths > 0)]
    return len(lengths) > 0 and bool((np.abs(lengths - 1) < tolerance).mean() >= least_share)


def _guess_names(rows: Float) -> list[str]:
    """Return names for the columns of a table without a header."""
    normal, color = ["nx", "ny", "nz"], ["red", "green", "blue"]
    extra = rows.shape[1] - 3
    if extra >= 3 and _are_unit_vectors(rows[:, 3:6]):
        rest = color if extra == 6 else ["intensity"] if extra == 4 else []
        names = [*normal, *rest]
    elif extra == 6 and _are_unit_vectors(rows[:, 6:9]):
        names = [*color, *normal]
    elif extra == 7 and _are_unit_vectors(rows[:, 7:10]):
        names = ["intensity", *color, *normal]
    else:
        names = {1: ["intensity"], 3: color, 4: ["intensity", *color]}.get(extra, [])
    return ["x", "y", "z", *names, *(f"column_{i + 1}" for i in range(3 + len(names), rows.shape[1]))]


def write_xyz(cloud: Mesh, path: Path) -> None:
    """Write the vertices with all their columns, and a line that names them: commented out unless the file is a CSV.

    Numbers have enough digits to read back exactly.
    """
    columns = vertex_columns(cloud)
    comma = path.suffix.lower() == ".csv"
    separator = "," if comma else " "
    words = ["%d" if values.dtype.kind in "biu" else "%r" for _, _, values in columns]
    # Formatting column by column keeps large integers exact.
    cells = [[word % number for number in values.tolist()] for word, (_, _, values) in zip(words, columns, strict=True)]
    with path.open("w", encoding="ascii", newline="\n") as file:
        file.write(("" if comma else "# ") + separator.join(name for name, _, _ in columns) + "\n")
        file.writelines(separator.join(row) + "\n" for row in zip(*cells, strict=True))


def xyz_chunks(path: Path, rows: int) -> Iterator[Contents]:
    """Yield the points of at most `rows` lines at a time; columns without names are guessed from the first block.

    Raises
    ------
    InputError
        As `read_xyz` does, with rows counted within a block.
    """
    with path.open("r", encoding="utf-8-sig", errors="replace") as file:
        names, count, body = split_head(_block(file, rows))
        first = parse_table(body)
        names = column_names(names, first)
        found = len(first)
        yield from_columns(dict(zip(names, first.T, strict=True)))
        while block := _block(file, rows):
            if not block.strip():
                continue
            values = parse_table(block)
            found += len(values)
            yield from_columns(dict(zip(column_names(names, values), values.T, strict=True)))
    if count is not None and found != count:
        raise InputError(f"the first line declares {count} points, but {found} follow.")


def _block(file: IO[str], rows: int) -> str:
    block = "".join(islice(file, rows))
    if "\0" in block:
        raise InputError("expected text, but the file holds binary data.")
    return block
