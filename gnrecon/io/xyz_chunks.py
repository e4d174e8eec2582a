"""Tables in text by chunks: blocks of whole lines, each read as a small file with the columns of the first one."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import IO

from gnrecon.io.contents import Contents, from_columns
from gnrecon.io.xyz import named, split, table
from gnrecon.runtime.errors import InputError


def xyz_chunks(path: Path, rows: int) -> Iterator[Contents]:
    """Yield the points of at most `rows` lines at a time. Columns without names are guessed from the first block.

    Raises
    ------
    InputError
        As `read_xyz` does, with rows counted within a block.
    """
    with path.open("r", encoding="utf-8-sig", errors="replace") as file:
        names, count, body = split(_block(file, rows))
        first = table(body)
        names = named(names, first)
        found = len(first)
        yield from_columns(dict(zip(names, first.T, strict=True)))
        while block := _block(file, rows):
            if not block.strip():
                continue
            values = table(block)
            found += len(values)
            yield from_columns(dict(zip(named(names, values), values.T, strict=True)))
    if count is not None and found != count:
        raise InputError(f"the first line declares {count} points, but {found} follow.")


def _block(file: IO[str], rows: int) -> str:
    block = "".join(islice(file, rows))
    if "\0" in block:
        raise InputError("expected text, but the file holds binary data.")
    return block
