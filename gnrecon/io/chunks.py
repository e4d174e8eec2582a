"""Large files by chunks, where their format allows it: LAS, LAZ, PTX, binary PLY without faces, and tables in text.

To add a format, write a function from a file and a number of rows to chunks, and a line in `CHUNKED`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

from gnrecon.io.contents import Contents
from gnrecon.io.las import las_chunks, settled
from gnrecon.io.plugged import reader_of
from gnrecon.io.ply_chunks import ply_chunks
from gnrecon.io.ptx import ptx_chunks
from gnrecon.io.xyz_chunks import xyz_chunks

LARGE = 1 << 24
"""Size of a file in bytes from which it is read by chunks."""

ROWS = 1 << 20
"""Points in a chunk: their arrays take some ten megabytes, and libraries work at full speed."""

CHUNKED: dict[str, Callable[[Path, int], Iterator[Contents]]] = {
    ".las": las_chunks,
    ".laz": las_chunks,
    ".ptx": ptx_chunks,
    ".ply": ply_chunks,
    **dict.fromkeys((".xyz", ".pts", ".txt", ".csv"), xyz_chunks),
}

SETTLED: dict[str, Callable[[Contents], Contents]] = {".las": settled, ".laz": settled}
"""What is done when all points of a file are known."""


def chunks(path: Path, extension: str) -> Iterator[Contents]:
    """Yield the contents of a file by chunks; small files, and formats that have to be read as a whole, in one.

    Raises
    ------
    InputError
        As the format's reader does; not before the first chunk is asked for.
    """
    if extension in CHUNKED and path.stat().st_size >= LARGE:
        yield from CHUNKED[extension](path, ROWS)
    elif read := reader_of(extension):
        yield read(path)
