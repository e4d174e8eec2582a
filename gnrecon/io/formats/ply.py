"""PLY, the Stanford polygon format: ASCII and binary of either byte order, any scalar types, polygons of any size.

A header names elements (vertex, face, ...) with their properties; rows of values follow. ASCII numbers are first
converted to an array of float64, which is then read like a binary file whose every property is a double, so that one
parser serves all three encodings. The parser is written here because common libraries round doubles, drop scalar
properties, reject polygons of differing size, or accept a truncated file.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from gnrecon.geometry.arrays import Int, Values
from gnrecon.geometry.colors import as_bytes
from gnrecon.geometry.mesh import Mesh
from gnrecon.io.contents import Contents, fan_triangles, from_columns, polygon_remarks
from gnrecon.io.parse import parse_numbers
from gnrecon.runtime.errors import InputError

Rows = dict[str, Any]
"""Values of one element by property: columns of shape (count,), and lists as pairs of lengths and all their values."""


def read_ply(path: Path) -> Contents:
    """Read vertices with all their scalar properties, and the faces where there are some."""
    data = path.read_bytes()
    order, elements, start = parse_header(data)
    numbers = data[start:]
    if not order:
        numbers = parse_numbers(numbers.decode("ascii", errors="replace").split()).tobytes()
    rows, body = dict[str, Rows](), _Body(numbers, order)
    for element in elements:
        rows[element.name] = body.next_rows(element)
        if {one.name for one in elements} & {"vertex", "face", "tristrips"} <= rows.keys():
            break  # what follows (range grids, edges, materials) is not used
    if "vertex" not in rows:
        raise InputError("the PLY header declares no vertex element.")
    found = [rows.get(name, {}) for name in ("face", "tristrips")]
    lists = [one.get("vertex_indices", one.get("vertex_index")) for one in found]
    corners, strips = (one if isinstance(one, tuple) else () for one in lists)
    faces = [fan_triangles(*corners)] if corners else []
    faces += [_strip_triangles(strips[1])] if strips else []
    columns = {name: values for name, values in rows["vertex"].items() if not isinstance(values, tuple)}
    contents = from_columns(columns, np.concatenate(faces) if faces else None)
    unread = _unread(elements) + (polygon_remarks(corners[0]) if corners else ())
    return replace(contents, unread=contents.unread + unread)


def _strip_triangles(corners: Int) -> Int:
    """The triangles of strips that -1 separates, as Stanford's scans have them; the orientation alternates."""
    ends = np.flatnonzero(np.append(corners, -1) < 0)
    counts = np.diff(ends, prepend=-1) - 1
    triangles = fan_triangles(counts, corners[corners >= 0], strips=True)
    # Strips repeat a vertex to turn; such triangles have no area.
    a, b, c = triangles.T
    kept: Int = triangles[(a != b) & (b != c) & (c != a)]
    return kept


def _unread(elements: list[Element]) -> tuple[str, ...]:
    """Describe everything that the header declares and this reader drops."""
    others = [one.name for one in elements if one.name not in ("vertex", "face", "tristrips") and one.count]
    found = [f"the element {name}" for name in others]
    for element in elements:
        names = {prop.name for prop in element.properties if element.name == "face" or prop.count_type}
        if element.count and element.name in ("vertex", "face"):
            found += [f"{name} of each {element.name}" for name in sorted(names - {"vertex_indices", "vertex_index"})]
    return tuple(found)


class _Body:
    """The rows of all elements; of a text, as doubles, whatever types the header states."""

    def __init__(self, data: bytes, order: str) -> None:
        self.data, self.order, self.place = data, order, 0

    def kind(self, name: str) -> np.dtype[Any]:
        """The type of stored numbers, by the name of its type in numpy."""
        return np.dtype(self.order + name if self.order else "f8")

    def next_rows(self, element: Element) -> Rows:
        """The rows of an element, which begin at the current place."""
        if not element.count or not element.properties:
            return {prop.name: np.empty(0, prop.type) for prop in element.properties if not prop.count_type}
        # Most files have lists of one length only, so that all rows take as many bytes as the first.
        step = int(self._starts(element, 1)[1]) - self.place
        rows: Rows | None = None
        # Checked before reading, because a damaged header may declare any number of rows.
        if (end := self.place + step * element.count) <= len(self.data):
            rows = self._rows_at(np.arange(self.place, end + 1, step), element, step)
        elif not any(prop.count_type for prop in element.properties):
            raise truncation_error(element, (len(self.data) - self.place) // step)
        if rows is None:
            starts = self._starts(element, element.count)
            rows, end = self._rows_at(starts, element), int(starts[-1])
        assert rows is not None, "rows end where the next ones start"
        self.place = end
        return rows

    def _starts(self, element: Element, rows: int) -> Int:
        """The offsets of so many rows, and the one after them, found by the lengths of the lists."""
        starts, place = [self.place], self.place
        sizes = [self.kind(prop.type).itemsize for prop in element.properties]
        counts = [prop.count_type and self._view(prop.count_type) for prop in element.properties]
        for row in range(rows):
            for prop, size, view in zip(element.properties, sizes, counts, strict=True):
                length = 1
                if isinstance(view, np.ndarray):
                    if place >= len(view):
                        raise truncation_error(element, row)
                    if not (view[place] >= 0 and view[place] % 1 == 0):
                        raise InputError(f"a list of {prop.name} has the length {view[place]:g}; a count was expected.")
                    length = int(view[place])
                    place += view.itemsize
                place += length * size
            if place > len(self.data):
                raise truncation_error(element, row)
            starts.append(place)
        return np.array(starts, np.int64)

    def _rows_at(self, starts: Int, element: Element, step: int | None = None) -> Rows | None:
        """The rows between these offsets, of shape (count + 1,); None where a row does not end at the next offset.

        Offsets of one `step` are a slice, which is read several times faster.
        """
        found, place = Rows(), starts[:-1].copy()
        for prop in element.properties:
            size = self.kind(prop.type).itemsize
            where = place if step is None else slice(place[0], place[-1] + 1, step)
            if not prop.count_type:
                found[prop.name] = self._native(self._view(prop.type)[where], prop)
                place += size
                continue
            lengths = _indices(self._view(prop.count_type)[where])
            place += self.kind(prop.count_type).itemsize
            after = place + lengths * size
            if (lengths < 0).any() or (after > starts[1:]).any():
                return None
            firsts = place - (np.cumsum(lengths) - lengths) * size
            items = np.repeat(firsts, lengths) + size * np.arange(lengths.sum())
            found[prop.name] = lengths, _indices(self._view(prop.type)[items])
            place, step = after, step if (lengths == lengths[0]).all() else None
        return found if (place == starts[1:]).all() else None

    def _view(self, name: str) -> Values:
        """The numbers of a type that begin at each byte."""
        kind = self.kind(name)
        return np.ndarray((max(len(self.data) - kind.itemsize + 1, 0),), kind, self.data, strides=(1,))

    def _native(self, values: Values, prop: Property) -> Values:
        """A column in this machine's byte order; text keeps all digits even where the header says float."""
        with np.errstate(invalid="ignore"):  # text may hold nan where the header declares an integer
            return values.astype(np.float64 if not self.order and prop.type.startswith("f") else prop.type)


def _indices(values: Values) -> Int:
    with np.errstate(invalid="ignore"):  # NaN becomes an index out of range, which Mesh refuses
        return values.astype(np.int64)


def write_ply(mesh: Mesh, path: Path) -> None:
    """Write binary little-endian PLY: positions as doubles, normals as floats, all attributes, and faces if any."""
    columns = vertex_columns(mesh)
    vertices = np.empty(len(mesh.vertices), np.dtype([(name, f"<{PLY_TYPES[kind]}") for name, kind, _ in columns]))
    for name, _, values in columns:
        vertices[name] = values
    faces = np.empty(len(mesh.faces), np.dtype([("count", "u1"), ("corners", "<i4", (3,))]))
    faces["count"] = 3
    faces["corners"] = mesh.faces
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    lines += [f"property {kind} {name}" for name, kind, _ in columns]
    if len(faces):  # every reader takes a file without the element for a cloud
        lines += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    lines += ["end_header", ""]
    with path.open("wb") as file:
        file.write("\n".join(lines).encode("ascii"))
        # Not `tofile`, which does not notice when the last bytes find the disk full.
        file.write(vertices.data)
        file.write(faces.data)


PLY_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2"},
    **{"int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8", "int64": "i8", "uint64": "u8", "bool": "u1"},
}
"""Names of number types in PLY and in numpy."""


@dataclass(frozen=True)
class Property:
    """One property of an element: a scalar, or a list with the type of its length (types as numpy names them)."""

    name: str
    type: str
    count_type: str | None


@dataclass(frozen=True)
class Element:
    """One element: `count` rows of the same properties."""

    name: str
    count: int
    properties: list[Property] = field(default_factory=list)


def parse_header(data: bytes) -> tuple[str, list[Element], int]:
    """Return the byte order (``<``, ``>``, or nothing for text), the elements, and where the rows begin in `data`."""
    if not data.startswith(b"ply"):
        raise InputError("the file does not begin with 'ply', so it is not a PLY file.")
    end = data.find(b"end_header")
    if end < 0:
        raise InputError("the PLY header does not end with 'end_header'.")
    # Lines end with LF, CR LF, or CR alone.
    close = re.compile(rb"\r" if data[3:4] == b"\r" and data[4:5] != b"\n" else rb"\n")
    found = close.search(data, end)
    start = found.end() if found else len(data)
    orders = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
    order: str | None = None
    elements: list[Element] = []
    for line in data[:end].decode("ascii", errors="replace").splitlines()[1:]:
        match line.split():
            case [] | ["comment" | "obj_info", *_]:
                continue
            case ["format", encoding, _] if encoding in orders:
                order = orders[encoding]
            case ["element", name, count] if count.isdecimal():
                # Some programs name the element of a cloud otherwise.
                other = name.lower() in ("point", "points", "vertices")
                elements.append(Element("vertex" if other else name, int(count)))
            case ["property", "list", count_type, kind, name] if elements and {count_type, kind} <= PLY_TYPES.keys():
                elements[-1].properties.append(Property(name, PLY_TYPES[kind], PLY_TYPES[count_type]))
            case ["property", kind, name] if elements and kind in PLY_TYPES:
                elements[-1].properties.append(Property(name, PLY_TYPES[kind], None))
            case _:
                raise InputError(f"the PLY header line {line.strip()[:80]!r} is not understood.")
    if order is None:
        raise InputError("the PLY header has no format line.")
    return order, elements, start


def truncation_error(element: Element, rows: int) -> InputError:
    """Return the error for a file that ends within the rows of `element`."""
    return InputError(f"the header declares {element.count} {element.name} rows, but the file ends after {rows}.")


def vertex_columns(mesh: Mesh) -> list[tuple[str, str, Values]]:
    """Return name, PLY type and values of all columns; an attribute of several becomes NAME_0, NAME_1, and so on."""
    # Doubles, because projected coordinates lose centimetres in single precision.
    columns: list[tuple[str, str, Values]] = [
        (name, "double", mesh.vertices[:, axis]) for axis, name in enumerate("xyz")
    ]
    if mesh.normals is not None:
        columns += [(f"n{name}", "float", mesh.normals[:, axis]) for axis, name in enumerate("xyz")]
    color_names = ("red", "green", "blue", "alpha")
    if "colors" in mesh.attributes:
        bytes_ = as_bytes(mesh.attributes["colors"])
        columns += [(name, "uchar", values) for name, values in zip(color_names, bytes_.T, strict=False)]
    taken = {"x", "y", "z", "nx", "ny", "nz", *color_names}
    for name, values in mesh.attributes.items():
        if name != "colors":
            rows = values.reshape(len(values), -1).T
            names = [name] if values.ndim == 1 else [f"{name}_{number}" for number in range(len(rows))]
            columns += [(_unique_word(one, taken), _ply_type(row), row) for one, row in zip(names, rows, strict=True)]
    return columns


def _unique_word(name: str, taken: set[str]) -> str:
    """Return the name as one ASCII word that is not taken, and mark it as taken."""
    word = re.sub(r"[^!-~]", "_", name) or "_"
    while word.lower() in taken:
        word += "_"
    taken.add(word.lower())
    return word


def _ply_type(values: Values) -> str:
    """PLY type of a column; 64-bit integers become 32-bit ones where they fit, else doubles."""
    kinds = {
        **{"b1": "uchar", "i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint"},
        **{"f2": "float", "f4": "float", "f8": "double"},
    }
    code = values.dtype.str[1:]
    for smaller in ("u4", "i4") if code in ("u8", "i8") and len(values) else ():
        limits = np.iinfo(smaller)
        code = smaller if limits.min <= values.min() and values.max() <= limits.max else code
    return kinds.get(code, "double")


def ply_chunks(path: Path, rows: int, *, header_bytes: int = 1 << 16) -> Iterator[Contents]:
    """Yield the vertices, at most `rows` at a time; files in text, with faces, or with lists are read as a whole.

    The header is searched in the first `header_bytes`, enough for some hundred properties, then in the whole file.
    """
    with path.open("rb") as file:
        head = file.read(header_bytes)
        order, elements, start = parse_header(head if b"end_header" in head else head + file.read())
        vertex = elements[0] if elements else Element("", 0)
        names = {prop.name for prop in vertex.properties if not prop.count_type}
        meshed = any(element.name in ("face", "tristrips") and element.count for element in elements)
        if not order or vertex.name != "vertex" or len(names) < len(vertex.properties) or meshed:
            yield read_ply(path)
            return
        layout = np.dtype([(prop.name, order + prop.type) for prop in vertex.properties])
        held = (path.stat().st_size - start) // max(layout.itemsize, 1)
        if held < vertex.count:
            raise truncation_error(vertex, held)
        file.seek(start)
        for first in range(0, vertex.count, rows):
            table = np.fromfile(file, layout, min(rows, vertex.count - first))
            found = from_columns({p.name: table[p.name].astype(p.type) for p in vertex.properties})
            yield replace(found, unread=found.unread + _unread(elements))
