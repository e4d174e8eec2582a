"""LAS and its compressed form LAZ, the lidar formats of the ASPRS, by laspy with lazrs.

Coordinates are stored as integers with a scale and an offset for each axis (specification LAS 1.4 R15, 2.4); they come
back as ``scale * integer + offset`` in float64, so that projected coordinates keep all their digits. A record has fixed
fields for everything that an aerial survey may measure; fields that are zero for all points were never filled in and
are dropped. Points marked as withheld are deleted ones, by the specification, and are not read.

A file's header is first checked against its size, because the library would allocate whatever a damaged one declares.
"""

from __future__ import annotations

import logging
import struct
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gnrecon.geometry.arrays import Values
from gnrecon.io.contents import Contents, concatenated, from_columns, guard_parser
from gnrecon.io.io_parameters import IOParameters
from gnrecon.runtime.errors import InputError

# The library logs short files, which would be printed; `_require_consistent_header` refuses them first.
logging.getLogger("laspy").addHandler(logging.NullHandler())


def read_las(path: Path) -> Contents:
    """Read all points with their attributes that are filled in: intensity, classification, colours, extra ones."""
    return drop_unused_attributes(concatenated(list(las_chunks(path, IOParameters.chunk_points))))


def las_chunks(path: Path, rows: int, *, most_chunk_bytes: int = 1 << 28) -> Iterator[Contents]:
    """Yield the points, at most `rows` at a time and in at most `most_chunk_bytes`: damaged records have any size."""
    import laspy

    _require_consistent_header(path)
    try:
        with (
            path.open("rb") as file,
            guard_parser("LAS or LAZ"),
            # The parallel decompressor trusts the sizes in a damaged file and aborts the process.
            laspy.open(file, closefd=False, laz_backend=laspy.LazBackend.Lazrs) as reader,
        ):
            count = left = reader.header.point_count
            rows = max(1, min(rows, most_chunk_bytes // max(reader.header.point_format.size, 1)))
            for chunk in reader.chunk_iterator(rows):
                left -= len(chunk)
                found = _contents(chunk)
                yield drop_unused_attributes(found) if len(chunk) == count else found
            if left:
                raise InputError(f"the header declares {count} points, but {left} of them are missing.")
    except MemoryError:  # chunks are small, so only damaged sizes can require so much
        raise InputError("the header declares records that are larger than this machine's memory.") from None


def drop_unused_attributes(contents: Contents) -> Contents:
    """Return all contents of a file without attributes that are zero everywhere, and with colours on their own scale.

    Colours have 16 bits by the specification. Where none exceeds 255, the program that wrote them has stored 8 bits.
    """
    filled = {name: values for name, values in contents.attributes.items() if (values != 0).any()}
    if "colors" in filled and filled["colors"].max() <= 255:
        filled["colors"] = filled["colors"].astype(np.uint8)
    return replace(contents, attributes=filled)


def _contents(chunk: Any) -> Contents:
    # X, Y and Z are the unscaled integers, and the flags describe processing, not the surface.
    skipped = {"X", "Y", "Z", "withheld", "synthetic", "key_point", "overlap"}
    names = [name for name in chunk.point_format.dimension_names if name not in skipped]
    used = np.asarray(chunk.withheld) == 0
    columns: dict[str, Values] = {axis: np.asarray(getattr(chunk, axis))[used] for axis in "xyz"}
    found = from_columns(columns | {name: np.asarray(chunk[name])[used] for name in names})
    return found if used.all() else replace(found, unread=(*found.unread, "points marked as withheld"))


def _require_consistent_header(
    path: Path, *, least_header_bytes: int = 227, record_bytes: int = 54, extended_record_bytes: int = 60
) -> None:
    """Refuse a missing header, or one that declares more than the file holds; sizes are those of the specification."""
    size = path.stat().st_size
    with path.open("rb") as file:
        # The header of LAS 1.4 has 375 bytes; that of older versions begins in the same way.
        head = file.read(375)
    if len(head) < least_header_bytes or not head.startswith(b"LASF"):
        raise InputError("the file does not begin with the header of a LAS file.")
    # At offset 94: header size, start of the points, number of records before them, point format, and the length and
    # number of points. LAS 1.4 repeats the number with 64 bits, after the extended records, at offset 235.
    minor, (header_size, start, vlrs, kind, length, count) = head[25], struct.unpack_from("<HIIBHI", head, 94)
    if minor >= 4 and len(head) == 375:
        evlr_start, evlrs, count = struct.unpack_from("<QIQ", head, 235)
        if evlrs and evlr_start + evlrs * extended_record_bytes > size:
            raise InputError("the header declares extended records that lie beyond the file's end.")
    if header_size < least_header_bytes or header_size + vlrs * record_bytes > start or start > size:
        raise InputError("the header's sizes contradict each other or the file's size.")
    held = (size - start) // max(length, 1)
    if kind & 0xC0:  # bits that mark a compressed file
        with path.open("rb") as file:
            records = file.read(start)
        # The record "laszip encoded" (LASzip specification, 22204) begins with the compressor: 1 is the old one.
        place = records.find(b"laszip encoded")
        if place >= 0 and records[place + 52 : place + 54] == b"\1\0":
            raise InputError(
                "it is compressed point by point, as LASzip did before 2011, which no library reads; "
                "convert it once with LAStools: laszip -i old.laz -o new.las."
            )
        _require_chunk_table(path, start, size)
    elif count > held:
        raise InputError(f"the header declares {count} points, but the file ends after {held}.")


def _require_chunk_table(path: Path, start: int, size: int, *, least_point_bytes: int = 20) -> None:
    """Refuse a table of compressed chunks that lies outside of the file, or lists more of them than it can hold.

    The first point of each chunk is not compressed, and takes at least `least_point_bytes`, those of format 0.
    """
    with path.open("rb") as file:
        file.seek(start)
        place = int.from_bytes(file.read(8), "little", signed=True)
        if place == -1:  # the program could not seek, and wrote the position at the end of the file
            file.seek(size - 8)
            place = int.from_bytes(file.read(8), "little", signed=True)
        file.seek(max(place, 0))
        table = file.read(8)
    chunks = int.from_bytes(table[4:], "little")
    if not start + 8 <= place <= size - 8 or len(table) < 8 or chunks * least_point_bytes > size:
        raise InputError("the table of compressed chunks contradicts the file's size.")
