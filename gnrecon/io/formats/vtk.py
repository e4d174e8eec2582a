"""VTK's legacy format (``# vtk DataFile Version``), as text or big-endian binary: polydata, grids and single points.

A file is a sequence of sections: a line that names a section and its size, then its numbers, as in VTK's manual "VTK
File Formats", up to version 5.1 with its offsets and connectivity. It is parsed here because VTK itself takes 140 MB
and aborts the process on some damaged files, and meshio does not read polydata.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from gnrecon.geometry.arrays import Float, Int, Values
from gnrecon.io.contents import Contents, fan_triangles, from_columns, no_faces
from gnrecon.io.parse import parse_numbers
from gnrecon.runtime.errors import InputError

_TYPES = {
    **{"unsigned_char": "u1", "char": "i1", "unsigned_short": "u2", "short": "i2", "unsigned_int": "u4", "int": "i4"},
    **{"unsigned_long": "u8", "long": "i8", "float": "f4", "double": "f8", "vtkidtype": "i4"},
    **{"vtktypeint64": "i8", "vtktypeuint64": "u8", "vtktypeint32": "i4"},
}
"""Number types, in lower case, and their names in numpy; ids have 32 bits."""


@dataclass
class _PolyData:
    """Data read so far."""

    points: Float | None = None
    faces: list[Int] = field(default_factory=list)
    arrays: dict[str, Values] = field(default_factory=dict)
    normals: str | None = None
    of_points: bool = False
    count: int = 0
    kind: str = "POLYDATA"
    numbers: dict[str, Float] = field(default_factory=dict)
    cells: tuple[Int, Int] | None = None
    unread: list[str] = field(default_factory=list)


def read_vtk(path: Path) -> Contents:
    """Read points with their arrays, and polygons and strips where there are some."""
    source = _Source(path.read_bytes())
    data = _PolyData()
    while words := source.words():
        _section(source, words, data)
    if data.kind in ("STRUCTURED_POINTS", "RECTILINEAR_GRID"):
        data.points = _lattice(data)
    if data.points is None:
        raise InputError("the file declares no points.")
    faces = np.concatenate(data.faces) if data.faces else no_faces()
    return assemble_contents(data.points, faces, data.arrays, data.normals, data.unread)


class _Source:
    """A file's bytes and the current position."""

    def __init__(self, data: bytes) -> None:
        lines = data.split(b"\n", 3)
        if not data.startswith(b"# vtk DataFile") or len(lines) < 4:
            raise InputError("the file does not begin like a legacy VTK file.")
        kind = lines[2].strip().upper()
        if kind not in (b"ASCII", b"BINARY"):
            raise InputError(f"expected ASCII or BINARY, but found {kind[:20].decode('ascii', 'replace')!r}.")
        self.data, self.binary = data, kind == b"BINARY"
        self.place = len(data) - len(lines[3])

    def words(self) -> list[str]:
        """The words of the next line that is neither blank nor metadata, which a blank line ends; none at the end."""
        metadata = False
        while self.place < len(self.data):
            end = self.data.find(b"\n", self.place) + 1 or len(self.data)
            line, self.place = self.data[self.place : end], end
            metadata = bool(line.strip()) and (metadata or line.strip() == b"METADATA")
            if line.strip() and not metadata:
                return line.decode("ascii", errors="replace").split()
        return []

    def numbers(self, count: int, kind: str) -> Values:
        """The next `count` numbers of a VTK type."""
        if kind.lower() not in _TYPES:
            raise InputError(f"the number type {kind[:40]!r} is unknown or not read.")
        dtype = np.dtype(_TYPES[kind.lower()])
        if self.binary:
            end = self.place + count * dtype.itemsize
            if end > len(self.data):
                raise InputError(f"the file ends within {count} numbers of the type {kind}.")
            block, self.place = self.data[self.place : end], end
            return np.frombuffer(block, dtype.newbyteorder(">")).astype(dtype)
        # Each number takes at least a byte; a larger count is refused before memory is allocated.
        if count > len(self.data) - self.place:
            raise InputError(f"the file ends within {count} numbers of the type {kind}.")
        words = self.data[self.place :].split(None, count)
        self.place = len(self.data) - (len(words.pop()) if len(words) > count else 0)
        if len(words) < count:
            raise InputError(f"the file ends after {len(words)} of {count} numbers of the type {kind}.")
        return text_numbers([word.decode("ascii", errors="replace") for word in words], dtype)


def _section(source: _Source, words: list[str], data: _PolyData) -> None:
    name = words[0].upper()
    match name:
        case "DATASET":
            data.kind = "".join(words[1:2]).upper()
            known = ("POLYDATA", "UNSTRUCTURED_GRID", "STRUCTURED_GRID", "STRUCTURED_POINTS", "RECTILINEAR_GRID")
            if data.kind not in known:
                raise InputError(f"the data set is {data.kind or 'unnamed'}, but {', '.join(known)} are read.")
        case "DIMENSIONS" | "ORIGIN" | "SPACING" | "ASPECT_RATIO":
            data.numbers[name] = parse_numbers(words[1:4])
        case "X_COORDINATES" | "Y_COORDINATES" | "Z_COORDINATES":
            data.numbers[name[0]] = source.numbers(_count(words, 1), _word(words, 2)).astype(np.float64)
        case "CELL_TYPES":
            _faces_of_types(source.numbers(_count(words, 1), "int"), data)
        case "POINTS":
            data.points = source.numbers(3 * _count(words, 1), _word(words, 2)).astype(np.float64).reshape(-1, 3)
        case "POINT_DATA" | "CELL_DATA":
            data.of_points, data.count = name == "POINT_DATA", _count(words, 1)
        case "CELLS" | "VERTICES" | "LINES" | "POLYGONS" | "TRIANGLE_STRIPS":
            _cells(source, words, data)
        case "FIELD":
            _fields(source, words, data)
        case _:
            _array(source, words, data)


def _count(words: list[str], place: int) -> int:
    text = _word(words, place)
    if not text.isdecimal():
        raise InputError(f"the line {' '.join(words)[:60]!r} holds {text[:20]!r} where a count was expected.")
    return int(text)


def _word(words: list[str], place: int) -> str:
    if len(words) <= place:
        raise InputError(f"the line {' '.join(words)[:60]!r} ends too early.")
    return words[place]


def _cells(source: _Source, words: list[str], data: _PolyData) -> None:
    """Read polygons with interleaved counts or, since version 5, with separate offsets."""
    rows, size, start = _count(words, 1), _count(words, 2), source.place
    following = source.words()
    if following[:1] == ["OFFSETS"]:
        offsets = source.numbers(rows, _word(following, 1)).astype(np.int64)
        following = source.words()
        if following[:1] != ["CONNECTIVITY"]:
            raise InputError("expected the line CONNECTIVITY after the offsets.")
        corners: Int = source.numbers(size, _word(following, 1)).astype(np.int64)
        counts = counts_from_offsets(offsets, corners)
    else:
        source.place = start
        counts, corners = _counted(source.numbers(size, "int").astype(np.int64), rows)
    name = words[0].upper()
    if name in ("POLYGONS", "TRIANGLE_STRIPS"):
        data.faces.append(triangulate_cells(counts, corners, strips=name == "TRIANGLE_STRIPS"))
    elif name == "CELLS":
        data.cells = counts, corners
    elif name == "LINES":
        data.unread.append("lines")


def _faces_of_types(types: Values, data: _PolyData) -> None:
    """Keep triangles, polygons and quadrangles (types 5, 7, 9), and strips (6), of an unstructured grid."""
    if data.cells is None or len(data.cells[0]) != len(types):
        raise InputError("the types of cells do not match the cells.")
    counts, corners = data.cells
    for kinds, strips in (((5, 7, 9), False), ((6,), True)):
        chosen = np.isin(types, kinds)
        if chosen.any():
            data.faces.append(triangulate_cells(counts[chosen], corners[np.repeat(chosen, counts)], strips=strips))
    if (others := ~np.isin(types, (1, 2, 5, 6, 7, 9))).any():
        data.unread.append(f"{int(others.sum())} cells that are no polygons")


def _lattice(data: _PolyData) -> Float:
    """The points of a regular or rectilinear grid, of shape (N, 3); x varies fastest."""
    axes = [data.numbers.get(axis, np.zeros(0)) for axis in "XYZ"]
    shape = np.array([float(len(axis)) for axis in axes])
    if data.kind == "STRUCTURED_POINTS":
        shape = data.numbers.get("DIMENSIONS", np.zeros(0))
    size = float(np.prod(shape))
    # A few bytes may declare any number of points.
    if len(shape) != 3 or not (shape >= 1).all() or size != data.count or not data.arrays:
        raise InputError(f"the grid has {size:.0f} points, but values of {data.count} points; a surface was expected.")
    if data.kind == "STRUCTURED_POINTS":
        spacing = data.numbers.get("SPACING", data.numbers.get("ASPECT_RATIO", np.ones(3)))
        origin = data.numbers.get("ORIGIN", np.zeros(3))
        axes = [start + step * np.arange(int(one)) for start, step, one in zip(origin, spacing, shape, strict=True)]
    z, y, x = np.meshgrid(*axes[::-1], indexing="ij")
    return np.column_stack([x.ravel(), y.ravel(), z.ravel()])


def _counted(values: Int, rows: int) -> tuple[Int, Int]:
    """Split ``n i0 ... i(n-1)``, repeated `rows` times, into counts and corners."""
    starts, place = list[int](), 0
    while len(starts) < rows and 0 <= place < len(values) and values[place] >= 0:
        starts.append(place)
        place += int(values[place]) + 1
    if place != len(values) or len(starts) < rows:
        raise InputError("the polygons do not have the size that their section declares.")
    return values[starts], np.delete(values, starts)


def _fields(source: _Source, words: list[str], data: _PolyData) -> None:
    for _ in range(_count(words, 2)):
        head = source.words()
        columns, rows = _count(head, 1), _count(head, 2)
        values = source.numbers(columns * rows, _word(head, 3))
        _keep(data, _word(head, 0), values, columns)


def _array(source: _Source, words: list[str], data: _PolyData) -> None:
    """Read one of the classic attributes of points or of polygons."""
    name, title = words[0].upper(), _word(words, 1) if len(words) > 1 else ""
    match name:
        case "SCALARS":
            columns = _count(words, 3) if len(words) > 3 else 1
            start = source.place
            # The line LOOKUP_TABLE is optional.
            if source.words()[:1] != ["LOOKUP_TABLE"]:
                source.place = start
            _keep(data, title, source.numbers(columns * data.count, _word(words, 2)), columns)
        case "COLOR_SCALARS":
            columns = _count(words, 2)
            values = source.numbers(columns * data.count, "unsigned_char" if source.binary else "float")
            # Text files store shares of full brightness.
            shares = values if source.binary else np.rint(255 * np.clip(values.astype(np.float64), 0, 1))
            _keep(data, title, shares.astype(np.uint8), columns)
        case "LOOKUP_TABLE":
            source.numbers(4 * _count(words, 2), "unsigned_char" if source.binary else "float")
        case "VECTORS" | "NORMALS":
            _keep(data, title, source.numbers(3 * data.count, _word(words, 2)), 3)
            data.normals = unquote(title) if name == "NORMALS" and data.of_points else data.normals
        case "TEXTURE_COORDINATES":
            source.numbers(_count(words, 2) * data.count, _word(words, 3))
            data.unread.append("texture coordinates")
        case "TENSORS":
            _keep(data, title, source.numbers(9 * data.count, _word(words, 2)), 9)
        case _:
            raise InputError(f"the line {' '.join(words)[:60]!r} does not begin a known section.")


def _keep(data: _PolyData, name: str, values: Values, columns: int) -> None:
    if data.of_points:
        data.arrays[unquote(name)] = values if columns == 1 else values.reshape(-1, max(columns, 1))
    elif "values of polygons or of the whole" not in data.unread:
        data.unread.append("values of polygons or of the whole")


# The rest is shared with the XML format, see `gnrecon.io.formats.vtp`.


def assemble_contents(
    points: Float, faces: Int, arrays: Mapping[str, Values], normals: str | None, unread: list[str]
) -> Contents:
    """Return the contents of a data set.

    Parameters
    ----------
    points : array of shape (N, 3)
    faces : integer array of shape (F, 3)
    arrays : the points' arrays by name, of shape (N,) or (N, C)
    normals : name of the array that holds the normals; by default ``Normals``, if there is one
    unread : what else the file holds

    Raises
    ------
    InputError
        When an array has another number of rows.
    """
    columns = dict(arrays)
    if normals in columns and columns[normals].shape[1:] == (3,):
        columns["normals"] = columns.pop(normals)
    # VTK displays an array of bytes as colours.
    shown = (
        name for name, one in columns.items() if one.dtype == np.uint8 and one.ndim == 2 and one.shape[1] in (3, 4)
    )
    if (name := next(shown, None)) is not None:
        columns = {"colors": columns.pop(name), **columns}
    found = from_columns(columns, faces, points)
    return replace(found, unread=(*unread, *found.unread))


def text_numbers(words: list[str], dtype: np.dtype[Any]) -> Values:
    """Return the words as an array of shape (len(words),): integers exactly, all others as float64."""
    return np.array([int(word) for word in words], dtype) if dtype.kind in "iu" else parse_numbers(words)


def triangulate_cells(counts: Int, corners: Int, strips: bool) -> Int:
    """Return the triangles, of shape (F, 3), of polygons or of triangle strips.

    Parameters
    ----------
    counts : integer array of shape (P,), corners of each
    corners : integer array of shape (counts.sum(),)
    strips : whether each is a strip, in which the orientation of triangles alternates
    """
    if not strips or not len(counts):
        return fan_triangles(counts, corners) if len(counts) else no_faces()
    starts = np.cumsum(counts) - counts
    found = []
    for start, count in zip(starts.tolist(), counts.tolist(), strict=True):
        strip = np.stack([corners[start + k : start + count - 2 + k] for k in range(3)], axis=1)
        # Every other triangle of a strip has the opposite orientation.
        strip[1::2] = strip[1::2, [1, 0, 2]]
        found.append(strip)
    return np.concatenate(found)


def counts_from_offsets(offsets: Int, corners: Int) -> Int:
    """Return how many corners each polygon has, of shape (P,), from offsets of shape (P + 1,) that begin with 0.

    Raises
    ------
    InputError
        When the offsets do not grow from 0 to the number of corners.
    """
    counts = np.diff(offsets)
    if len(offsets) and (offsets[0] != 0 or offsets[-1] != len(corners) or (counts < 0).any()):
        raise InputError("the offsets of the polygons do not grow from 0 to the number of their corners.")
    return counts
