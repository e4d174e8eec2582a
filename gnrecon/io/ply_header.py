"""The header of a PLY file: its encoding, its elements and their properties."""

from __future__ import annotations

from dataclasses import dataclass, field

from gnrecon.runtime.errors import InputError

PLY_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2"},
    **{"int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8", "int64": "i8", "uint64": "u8"},
}
ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


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
    """Return the encoding, the elements, and where the rows begin in `data`.

    Raises
    ------
    InputError
        When the header does not begin, end, or read as PLY prescribes.
    """
    if not data.startswith(b"ply"):
        raise InputError("the file does not begin with 'ply', so it is no PLY file.")
    end = data.find(b"end_header")
    if end < 0:
        raise InputError("the PLY header does not end with 'end_header'.")
    start = data.find(b"\n", end) + 1 or len(data)
    encoding = ""
    elements: list[Element] = []
    for line in data[:end].decode("ascii", errors="replace").splitlines()[1:]:
        match line.split():
            case [] | ["comment" | "obj_info", *_]:
                continue
            case ["format", name, _] if name in ORDERS:
                encoding = name
            case ["element", name, count] if count.isdecimal():
                elements.append(Element(name, int(count)))
            case ["property", "list", count_type, kind, name] if elements and {count_type, kind} <= PLY_TYPES.keys():
                elements[-1].properties.append(Property(name, PLY_TYPES[kind], PLY_TYPES[count_type]))
            case ["property", kind, name] if elements and kind in PLY_TYPES:
                elements[-1].properties.append(Property(name, PLY_TYPES[kind], None))
            case _:
                raise InputError(f"the PLY header line {line.strip()[:80]!r} is not understood.")
    if not encoding:
        raise InputError("the PLY header has no format line.")
    return encoding, elements, start


def too_short(element: Element, rows: int) -> InputError:
    """Return the failure of a file that ends within the rows of `element`."""
    return InputError(f"the header declares {element.count} {element.name} rows, but the file ends after {rows}.")
