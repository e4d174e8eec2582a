"""Columns of numbers in text (XYZ, ASC, PTS, TXT, CSV, DAT): any separator, decimal mark, quotes, encoding and header.

`table_dialect` finds out how the rows are written, pandas parses them, and `table_columns` says what they hold. A line
with a single count, as before each block of a PTS file, is checked against the rows.
"""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np

from gnrecon.geometry.arrays import Float
from gnrecon.geometry.mesh import Mesh
from gnrecon.io.contents import Contents, from_columns
from gnrecon.io.formats.ply import vertex_columns
from gnrecon.io.formats.table_columns import guessed, named_by_user
from gnrecon.io.formats.table_dialect import BLANKS, COMMENT, MISSING, Dialect, encoding_of, find_dialect, plain_text
from gnrecon.runtime.errors import InputError

TABLE_SUFFIXES = (".xyz", ".pts", ".txt", ".csv", ".asc", ".xyzn", ".xyzrgb", ".dat")


def table_chunks(
    path: Path, rows: int, columns: Sequence[str] = (), extension: str = "", *, sampled_lines: int = 400
) -> Iterator[Contents]:
    """Yield the points of at most `rows` lines at a time; what the columns are is decided on the first block.

    `columns` are their names where the user gives them. The extension, by which the file is read, says what the columns
    of some tables are.
    """
    with path.open("r", encoding=encoding_of(path), errors="replace") as file:
        lines, head = list[str](), [""]
        while head and not COMMENT.sub("", "".join(head)).strip():
            head = list(map(plain_text, islice(file, sampled_lines)))
            lines += head
        if columns:
            # The user's names stand in place of any header, which may hold names of all kinds.
            lines = [line if re.search(r"\d", line) else "\n" for line in lines]
        dialect = find_dialect(lines)
        file.seek(0)
        list(islice(file, dialect.skipped))
        kept: list[tuple[int, str]] | None = None
        found, declared, remarks = 0, dialect.count, dialect.remarks
        while block := "".join(islice(file, rows)):
            text, counts = _cleaned(block, dialect)
            declared = declared if declared is None else declared + sum(counts)
            if not text.strip():
                continue
            table = _parsed(text, dialect, found)
            if kept is None:
                kept, more = _kept(dialect, table, extension, columns)
                remarks += more
            found += len(table)
            contents = from_columns({name: table[:, place].copy() for place, name in kept})
            unread = () if columns else _columns_of_text(dialect)
            yield replace(contents, unread=contents.unread + unread, remarks=remarks)
    if declared is not None and found != declared:
        raise InputError(f"the file declares {declared} points, but {found} follow.")


def _kept(
    dialect: Dialect, table: Float, suffix: str, columns: Sequence[str]
) -> tuple[list[tuple[int, str]], tuple[str, ...]]:
    """Return place and name of each column that is read, and sentences on what was guessed."""
    places = [place for place, numeric in enumerate(dialect.numeric) if numeric]
    remarks: tuple[str, ...] = ()
    if columns:
        names = named_by_user(columns, dialect.width)
        if wrong := [name for name, numeric in zip(names, dialect.numeric, strict=True) if name and not numeric]:
            raise InputError(f"the column {wrong[0]!r} of --columns does not hold numbers.")
    elif dialect.names is not None:
        names = list(dialect.names)
    else:
        found, remarks = guessed(table[:, places], places, suffix)
        names = [""] * dialect.width
        for place, name in zip(places, found, strict=True):
            names[place] = "" if name == "index" else name
    kept: dict[str, int] = {}
    for place in places:
        if names[place]:
            kept.setdefault(names[place] if names[place] not in kept else f"{names[place]}_{place + 1}", place)
    return [(place, name) for name, place in kept.items()], remarks


def _columns_of_text(dialect: Dialect) -> tuple[str, ...]:
    names = dialect.names or [f"number {place + 1}" for place in range(dialect.width)]
    texts = [name for name, numeric in zip(names, dialect.numeric, strict=True) if name and not numeric]
    return (f"the columns without numbers ({', '.join(texts)})",) if texts else ()


def _cleaned(block: str, dialect: Dialect) -> tuple[str, list[int]]:
    """Return the rows of a block without comments and lines of counts, and these counts."""
    if "\0" in block:
        raise InputError("expected text, but the file holds binary data.")
    if any(mark in block for mark in ("#", "//", "%", "!")) or (dialect.separator != ";" and ";" in block):
        block = COMMENT.sub("", block)
    block = plain_text(block)
    counts: list[int] = []
    if dialect.count is not None:
        counts = [int(word) for word in re.findall(r"^[ \t]*([0-9]{1,18})[ \t]*$", block, re.MULTILINE)]
        block = re.sub(r"^[ \t]*[0-9]{1,18}[ \t]*$", "", block, flags=re.MULTILINE) if counts else block
    for old, new in dialect.replaced:
        block = block.replace(old, new)
    return block, counts


def _parsed(text: str, dialect: Dialect, before: int) -> Float:
    """Return the rows as an array of shape (N, columns), NaN where a column holds text."""
    import pandas

    width = dialect.width
    # One more column shows rows that are too long, which pandas would otherwise cut off.
    places = range(width if dialect.ragged else width + 1)
    kinds = {place: np.float64 if place == width or dialect.numeric[place] else str for place in places}
    missing = [*MISSING, *map(str.upper, MISSING), *map(str.title, MISSING), "NaN", "#N/A", "#VALUE!"]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", pandas.errors.ParserWarning)
            frame = pandas.read_csv(
                io.BytesIO(text.encode("utf-8", "replace")),
                header=None,
                names=list(places),
                usecols=list(places) if dialect.ragged else None,
                index_col=False,
                dtype=kinds,
                sep=dialect.separator,
                decimal=dialect.decimal,
                thousands=dialect.thousands,
                skipinitialspace=dialect.separator != BLANKS,
                keep_default_na=False,
                na_values=list(dict.fromkeys(missing)),
            )
    except (ValueError, OverflowError, pandas.errors.ParserError, pandas.errors.ParserWarning) as error:
        _require_rows(text, dialect, before)
        raise InputError(f"the rows are not a table of numbers ({str(error).partition(chr(10))[0]}).") from None
    table = np.full((len(frame), width), np.nan)
    for place in (place for place, numeric in enumerate(dialect.numeric) if numeric):
        table[:, place] = frame[place].to_numpy()
    # A row that is too short looks like one with an empty cell at its end.
    short = bool(np.isnan(table[:, -1]).any() if dialect.numeric[-1] else frame[width - 1].isna().any())
    long = not dialect.ragged and bool(frame[width].notna().any())
    if long or short:
        _require_rows(text, dialect, before)
    return table


def _require_rows(text: str, dialect: Dialect, before: int) -> None:
    """Refuse the first row that has not as many cells as the others, or a cell that is no number."""
    plain = replace(dialect, replaced=())
    rows = (plain.cells(line) for line in text.split("\n") if line.strip())
    for row, cells in enumerate(rows, before + 1):
        if len(cells) < dialect.width or (not dialect.ragged and any(cells[dialect.width :])):
            raise InputError(f"row {row} holds {len(cells)} numbers, but the rows before it hold {dialect.width}.")
        for cell, numeric in zip(cells, dialect.numeric, strict=False):
            if numeric and not dialect.is_value(cell):
                raise InputError(f"{cell[:40]!r} in row {row} is not a number; --columns can skip a column of text.")


def write_table(cloud: Mesh, path: Path) -> None:
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
