"""VTK's legacy format (``# vtk DataFile Version``), as text or big-endian binary: polydata, grids and single points.

A file is a sequence of sections: a line that names a section and its size, then its numbers, as in VTK's manual "VTK
File Formats", up to version 5.1 with its offsets and connectivity. It is parsed here because VTK itself takes 140 MB
and aborts the process on some damaged files, and meshio does not read polydata.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
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


def read_vtk(path: Path) -> Contents:
    """Read points with their arrays, and polygons and strips where there are some."""
    file = _VtkLegacy(path.read_bytes())
    while words := file.words():
        file.read_section(words[0].upper(), words)
    points = _lattice(file) if file.kind in ("STRUCTURED_POINTS", "RECTILINEAR_GRID") else file.points
    if points is None:
        raise InputError("the file declares no points.")
    return assemble_contents(points, np.concatenate([no_faces(), *file.faces]), file.arrays, file.normals, file.unread)


class _VtkLegacy:
    """A file's bytes, the place of what is read next, and what its sections hold."""

    def __init__(self, data: bytes) -> None:
        lines = data.split(b"\n", 3)
        if not data.startswith(b"# vtk DataFile") or len(lines) < 4:
            raise InputError("the file does not begin like a legacy VTK file.")
        encoding = lines[2].strip().upper()
        if encoding not in (b"ASCII", b"BINARY"):
            raise InputError(f"expected ASCII or BINARY, but found {encoding[:20].decode('ascii', 'replace')!r}.")
        self.data, self.binary, self.place = data, encoding == b"BINARY", len(data) - len(lines[3])
        self.kind, self.rows, self.of_points = "POLYDATA", 0, False
        self.points: Float | None = None
        self.held: dict[str, Float] = {}
        self.cells: tuple[Int, Int] = (np.empty(0, np.int64), np.empty(0, np.int64))
        self.faces: list[Int] = []
        self.arrays: dict[str, Values] = {}
        self.normals: str | None = None
        self.unread: list[str] = []

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

    def words_of(self, name: str) -> list[str]:
        """The words of the next line if it begins with a name; else none, and the line is still to be read."""
        place, words = self.place, self.words()
        self.place = self.place if words[:1] == [name] else place
        return words if words[:1] == [name] else []

    def numbers(self, count: int, kind: str) -> Values:
        """The next `count` numbers of a VTK type."""
        if kind.lower() not in _TYPES:
            raise InputError(f"the number type {kind[:40]!r} is unknown or not read.")
        dtype = np.dtype(_TYPES[kind.lower()])
        # In text, each takes at least a byte; a larger count is refused before memory is allocated.
        size = count * (dtype.itemsize if self.binary else 1)
        if self.place + size > len(self.data):
            raise InputError(f"the file ends within {count} numbers of the type {kind}.")
        if self.binary:
            block, self.place = self.data[self.place : self.place + size], self.place + size
            return np.frombuffer(block, dtype.newbyteorder(">")).astype(dtype)
        words = self.data[self.place :].split(None, count)
        self.place = len(self.data) - (len(words.pop()) if len(words) > count else 0)
        if len(words) < count:
            raise InputError(f"the file ends after {len(words)} of {count} numbers of the type {kind}.")
        return text_numbers([word.decode("ascii", errors="replace") for word in words], dtype)

    def read_section(self, name: str, words: list[str]) -> None:
        """Read the section that a line of these words begins."""
        # Colours are bytes in binary files, and shares of full brightness in text.
        shade = "unsigned_char" if self.binary else "float"
        title = words[1] if len(words) > 1 else ""
        match name:
            case "DATASET":
                self.kind = "".join(words[1:2]).upper()
                known = "POLYDATA, UNSTRUCTURED_GRID, STRUCTURED_GRID, STRUCTURED_POINTS, RECTILINEAR_GRID"
                if self.kind not in known.split(", "):
                    raise InputError(f"the data set is {self.kind or 'unnamed'}, but {known} are read.")
            case "DIMENSIONS" | "ORIGIN" | "SPACING" | "ASPECT_RATIO":
                self.held[name] = parse_numbers(words[1:4])
            case "X_COORDINATES" | "Y_COORDINATES" | "Z_COORDINATES":
                self.held[name[0]] = self.numbers(_count(words, 1), _word(words, 2)).astype(np.float64)
            case "POINTS":
                self.points = self.numbers(3 * _count(words, 1), _word(words, 2)).astype(np.float64).reshape(-1, 3)
            case "CELLS" | "VERTICES" | "LINES" | "POLYGONS" | "TRIANGLE_STRIPS":
                self._read_cells(name, _count(words, 1), _count(words, 2))
            case "CELL_TYPES":
                self._choose_faces(self.numbers(_count(words, 1), "int"))
            case "POINT_DATA" | "CELL_DATA":
                self.of_points, self.rows = name == "POINT_DATA", _count(words, 1)
            case "FIELD":
                for _ in range(_count(words, 2)):
                    head = self.words()
                    columns = _count(head, 1)
                    self._keep(head[0], self.numbers(columns * _count(head, 2), _word(head, 3)), columns)
            case "SCALARS":
                columns = _count(words, 3) if len(words) > 3 else 1
                self.words_of("LOOKUP_TABLE")  # which is optional
                self._keep(title, self.numbers(columns * self.rows, _word(words, 2)), columns)
            case "COLOR_SCALARS":
                values = self.numbers(_count(words, 2) * self.rows, shade)
                values = values if self.binary else np.rint(255 * np.clip(values.astype(np.float64), 0, 1))
                self._keep(title, values.astype(np.uint8), _count(words, 2))
            case "LOOKUP_TABLE":
                self.numbers(4 * _count(words, 2), shade)
            case "VECTORS" | "NORMALS" | "TENSORS":
                columns = 9 if name == "TENSORS" else 3
                self._keep(title, self.numbers(columns * self.rows, _word(words, 2)), columns)
                self.normals = unquote(title) if name == "NORMALS" and self.of_points else self.normals
            case "TEXTURE_COORDINATES":
                self.numbers(_count(words, 2) * self.rows, _word(words, 3))
                self.unread.append("texture coordinates")
            case _:
                raise InputError(f"the line {' '.join(words)[:60]!r} does not begin a known section.")

    def _read_cells(self, name: str, rows: int, size: int) -> None:
        """Read polygons with interleaved counts or, since version 5, with separate offsets."""
        if words := self.words_of("OFFSETS"):
            offsets = self.numbers(rows, _word(words, 1)).astype(np.int64)
            if not (words := self.words_of("CONNECTIVITY")):
                raise InputError("expected the line CONNECTIVITY after the offsets.")
            corners: Int = self.numbers(size, _word(words, 1)).astype(np.int64)
            counts = counts_from_offsets(offsets, corners)
        else:
            counts, corners = _counted(self.numbers(size, "int").astype(np.int64), rows)
        if name in ("POLYGONS", "TRIANGLE_STRIPS"):
            self.faces.append(fan_triangles(counts, corners, strips=name == "TRIANGLE_STRIPS"))
        elif name == "CELLS":
            self.cells = counts, corners
        elif name == "LINES":
            self.unread.append("lines")

    def _choose_faces(self, types: Values) -> None:
        """Keep triangles, polygons and quadrangles (types 5, 7, 9), and strips (6), of an unstructured grid."""
        counts, corners = self.cells
        if len(counts) != len(types):
            raise InputError("the types of cells do not match the cells.")
        for kinds, strips in (((5, 7, 9), False), ((6,), True)):
            chosen = np.isin(types, kinds)
            self.faces.append(fan_triangles(counts[chosen], corners[np.repeat(chosen, counts)], strips=strips))
        if (others := ~np.isin(types, (1, 2, 5, 6, 7, 9))).any():
            self.unread.append(f"{int(others.sum())} cells that are no polygons")

    def _keep(self, name: str, values: Values, columns: int) -> None:
        if self.of_points:
            self.arrays[unquote(name)] = values if columns == 1 else values.reshape(-1, max(columns, 1))
        else:
            self.unread.append("values of polygons or of the whole")


def _count(words: list[str], place: int) -> int:
    if not (text := _word(words, place)).isdecimal():
        raise InputError(f"the line {' '.join(words)[:60]!r} holds {text[:20]!r} where a count was expected.")
    return int(text)


def _word(words: list[str], place: int) -> str:
    if len(words) <= place:
        raise InputError(f"the line {' '.join(words)[:60]!r} ends too early.")
    return words[place]


def _lattice(file: _VtkLegacy) -> Float:
    """The points of a regular or rectilinear grid, of shape (N, 3); x varies fastest."""
    held, regular = file.held, file.kind == "STRUCTURED_POINTS"
    axes = [held.get(axis, np.zeros(0)) for axis in "XYZ"]
    shape = held.get("DIMENSIONS", np.zeros(0)) if regular else np.array(list(map(len, axes)), np.float64)
    size = float(np.prod(shape))
    # A few bytes may declare any number of points.
    if len(shape) != 3 or not (shape >= 1).all() or size != file.rows or not file.arrays:
        raise InputError(f"the grid has {size:.0f} points, but values of {file.rows} points; a surface was expected.")
    if regular:
        spacing = held.get("SPACING", held.get("ASPECT_RATIO", np.ones(3)))
        origin = held.get("ORIGIN", np.zeros(3))
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


def assemble_contents(
    points: Float, faces: Int, arrays: Mapping[str, Values], normals: str | None, unread: list[str]
) -> Contents:
    """Return the contents of a data set, with the arrays of its points by name, and what else the file holds.

    `normals` names the array that holds the normals; by default it is ``Normals``, if there is one.
    """
    columns = dict(arrays)
    if normals in columns and columns[normals].shape[1:] == (3,):
        columns["normals"] = columns.pop(normals)
    # VTK displays an array of bytes as colours.
    shown = [name for name, one in columns.items() if one.dtype == np.uint8 and one.shape[1:] in ((3,), (4,))]
    if shown:
        columns = {"colors": columns.pop(shown[0]), **columns}
    found = from_columns(columns, faces, points)
    return replace(found, unread=(*dict.fromkeys(unread), *found.unread))


def text_numbers(words: list[str], dtype: np.dtype[Any]) -> Values:
    """Return the words as an array of shape (len(words),): integers exactly, all others as float64."""
    return np.array([int(word) for word in words], dtype) if dtype.kind in "iu" else parse_numbers(words)


def counts_from_offsets(offsets: Int, corners: Int) -> Int:
    """Return how many corners each polygon has, of shape (P,), from offsets of shape (P + 1,) that begin with 0."""
    counts = np.diff(offsets)
    if len(offsets) and (offsets[0] != 0 or offsets[-1] != len(corners) or (counts < 0).any()):
        raise InputError("the offsets of the polygons do not grow from 0 to the number of their corners.")
    return counts
