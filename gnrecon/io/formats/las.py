"""LAS and its compressed form LAZ, the lidar formats of the ASPRS, by laspy with lazrs.

Coordinates are stored as integers with a scale and an offset for each axis (specification LAS 1.4 R15, 2.4); they come
back as ``scale * integer + offset`` in float64, so that projected coordinates keep all their digits. A record has a
fixed place for everything that an aerial survey may know; what is zero for all points was never filled in and is left
out. Points that are marked as withheld are deleted ones, by the specification, and are not read.

A file's header is compared with its size first: the library would else allocate, or loop over, whatever it is told.
"""

from __future__ import annotations

import logging
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gnrecon.geometry.arrays import Mask, Values
from gnrecon.io.contents import Columns, Contents, from_columns, joined, parsing
from gnrecon.runtime.errors import InputError

_LEAST_HEADER, _VLR, _EVLR = 227, 54, 60  # bytes, from the specification
_COMPRESSED = 0xC0
"""Bits of the point format by which compressed files are told."""

_LEAST_POINT = 20
"""Bytes of a point in the smallest format; the first one of each compressed chunk is stored so."""

_MOST_BYTES = 1 << 28
"""Of the records in a chunk: those of a damaged file may be any size."""

_SKIPPED = ("X", "Y", "Z", "red", "green", "blue", "withheld", "synthetic", "key_point", "overlap")

# The library reports short files on the log, which would print there; `_require_all` refuses them before.
logging.getLogger("laspy").addHandler(logging.NullHandler())


def read_las(path: Path) -> Contents:
    """Read all points with what is filled in of their attributes: intensity, classification, colours, extra ones.

    Raises
    ------
    InputError
        When the file is malformed or shorter than its header says.
    """
    return settled(joined(list(las_chunks(path, 1 << 20)) or [Contents(np.empty((0, 3)))]))


def las_chunks(path: Path, rows: int) -> Iterator[Contents]:
    """Yield the points, at most `rows` at a time.

    Raises
    ------
    InputError
        As `read_las` does.
    """
    import laspy

    _require_all(path)
    # The parallel decompressor takes the sizes that a damaged file states for granted, and ends the process.
    backend = laspy.LazBackend.Lazrs
    with (
        path.open("rb") as file,
        parsing("LAS or LAZ"),
        _no_more_than_it_holds(),
        laspy.open(file, closefd=False, laz_backend=backend) as reader,
    ):
        left = reader.header.point_count
        rows = max(1, min(rows, _MOST_BYTES // max(reader.header.point_format.size, 1)))
        for chunk in reader.chunk_iterator(rows):
            left -= len(chunk)
            yield _contents(chunk)
        if left:
            raise InputError(f"the header declares {reader.header.point_count} points, but {left} of them are missing.")


@contextmanager
def _no_more_than_it_holds() -> Iterator[None]:
    """Take want of memory for what it is here: chunks are small, so only damaged sizes can ask for so much."""
    try:
        yield
    except MemoryError:
        raise InputError("the header declares records that are larger than this machine's memory.") from None


def settled(contents: Contents) -> Contents:
    """Return all contents of a file without attributes that are zero everywhere, and with colours on their own scale.

    Colours have 16 bits by the specification. Where none exceeds 255, a program has put 8-bit ones into their places.
    """
    filled = {name: values for name, values in contents.attributes.items() if (values != 0).any()}
    if "colors" in filled and filled["colors"].max() <= 255:
        filled["colors"] = filled["colors"].astype(np.uint8)
    return replace(contents, attributes=filled)


def _contents(chunk: Any) -> Contents:
    names = [name for name in chunk.point_format.dimension_names if name not in _SKIPPED]
    used = np.asarray(chunk.withheld) == 0
    columns: dict[str, Values] = {axis: np.asarray(getattr(chunk, axis))[used] for axis in "xyz"}
    columns |= {name: np.asarray(chunk[name])[used] for name in names}
    found = from_columns(columns)
    dropped = len(used) - int(used.sum())
    return Contents(
        found.points,
        found.normals,
        found.faces,
        {**found.attributes, **_colors(chunk, used)},
        ("points marked as withheld",) if dropped else (),
    )


def _colors(chunk: Any, used: Mask) -> Columns:
    if "red" not in chunk.point_format.dimension_names:
        return {}
    return {"colors": np.column_stack([np.asarray(chunk[name])[used] for name in ("red", "green", "blue")])}


def _require_all(path: Path) -> None:
    """Refuse a header that is none, or that declares more than the file holds.

    Raises
    ------
    InputError
        With the sentence that says which.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(375)
    if len(head) < _LEAST_HEADER or not head.startswith(b"LASF"):
        raise InputError("the file does not begin with the header of a LAS file.")
    minor, (header_size, start, vlrs, kind, length, count) = head[25], struct.unpack_from("<HIIBHI", head, 94)
    if minor >= 4 and len(head) == 375:
        evlr_start, evlrs, count = struct.unpack_from("<QIQ", head, 235)
        if evlrs and evlr_start + evlrs * _EVLR > size:
            raise InputError("the header declares extended records that lie beyond the file's end.")
    if header_size < _LEAST_HEADER or header_size + vlrs * _VLR > start or start > size:
        raise InputError("the header's sizes contradict each other or the file's size.")
    held = (size - start) // max(length, 1)
    if kind & _COMPRESSED:
        _require_chunk_table(path, start, size)
    elif count > held:
        raise InputError(f"the header declares {count} points, but the file ends after {held}.")


def _require_chunk_table(path: Path, start: int, size: int) -> None:
    """Refuse a table of compressed chunks that lies outside of the file, or lists more of them than it can hold."""
    with path.open("rb") as file:
        file.seek(start)
        place = int.from_bytes(file.read(8), "little", signed=True)
        if place == -1:  # written behind everything else, by a program that could not go back
            file.seek(size - 8)
            place = int.from_bytes(file.read(8), "little", signed=True)
        file.seek(max(place, 0))
        table = file.read(8)
    chunks = int.from_bytes(table[4:], "little")
    if not start + 8 <= place <= size - 8 or len(table) < 8 or chunks * _LEAST_POINT > size:
        raise InputError("the table of compressed chunks contradicts the file's size.")
