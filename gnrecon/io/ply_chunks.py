"""Binary PLY by chunks: the vertices of a cloud are records of one size, so that any stretch of them can be read."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from gnrecon.io.contents import Contents, from_columns
from gnrecon.io.ply import read_ply
from gnrecon.io.ply_header import ORDERS, Element, parse_header, too_short

_HEADER = 1 << 16
"""Bytes in which a header that names some hundred properties ends."""


def ply_chunks(path: Path, rows: int) -> Iterator[Contents]:
    """Yield the vertices, at most `rows` at a time; files in text, with faces, or with lists are read as a whole.

    Raises
    ------
    InputError
        As `read_ply` does.
    """
    with path.open("rb") as file:
        head = file.read(_HEADER)
        encoding, elements, start = parse_header(head if b"end_header" in head else head + file.read())
        order = ORDERS[encoding]
        if not order or not _is_cloud(elements):
            yield read_ply(path)
            return
        vertex = elements[0]
        layout = np.dtype([(prop.name, order + prop.type) for prop in vertex.properties])
        held = (path.stat().st_size - start) // max(layout.itemsize, 1)
        if held < vertex.count:
            raise too_short(vertex, held)
        file.seek(start)
        for first in range(0, vertex.count, rows):
            table = np.fromfile(file, layout, min(rows, vertex.count - first))
            yield from_columns({p.name: table[p.name].astype(p.type) for p in vertex.properties})


def _is_cloud(elements: list[Element]) -> bool:
    """Whether the vertices come first, have single values only, and no face follows."""
    first = elements[0] if elements else Element("", 0)
    names = [prop.name for prop in first.properties]
    plain = all(prop.count_type is None for prop in first.properties) and len(set(names)) == len(names)
    faces = any(element.name == "face" and element.count for element in elements)
    return first.name == "vertex" and plain and not faces
