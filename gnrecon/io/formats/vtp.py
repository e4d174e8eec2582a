"""VTP, VTU and VTS, VTK's XML formats: arrays as text, base64 or raw bytes, in place or appended, also compressed.

After VTK's manual "VTK File Formats", section XML. Binary arrays begin with a count of bytes; compressed ones with the
number of blocks, the size of a block, that of the last one, and the compressed size of each. They are parsed here for
the reasons in `gnrecon.io.formats.vtk`.
"""

from __future__ import annotations

import binascii
import itertools
import lzma
import re
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from gnrecon.geometry.arrays import Int, Values
from gnrecon.io.contents import Contents, concatenated, fan_triangles, no_faces
from gnrecon.io.formats.vtk import assemble_contents, counts_from_offsets, text_numbers
from gnrecon.runtime.errors import InputError


@dataclass(frozen=True)
class _VtkXml:
    """How a file's arrays are stored, and the block that is appended to its XML."""

    order: str
    header: np.dtype[np.generic]
    decompress: Callable[[bytes], bytes] | None
    appended: bytes
    raw: bool


def read_vtp(path: Path) -> Contents:
    """Read all pieces into one: points with their arrays, and polygons and strips where there are some."""
    try:
        root, file = _open(path.read_bytes())
        pieces = [_piece(piece, file) for piece in root.iterfind("*/Piece")]
    except (ElementTree.ParseError, zlib.error, lzma.LZMAError, binascii.Error) as error:
        raise InputError(f"the file is not a well-formed file of VTK ({error}).") from None
    if not pieces:
        raise InputError("the file holds no piece of a data set.")
    return concatenated(pieces)


def _open(data: bytes) -> tuple[ElementTree.Element, _VtkXml]:
    """Return the XML without the appended block, and how arrays are read."""
    libraries: dict[str, Any] = {"vtkZLibDataCompressor": zlib, "vtkLZMADataCompressor": lzma}
    xml, _, rest = data.partition(b"<AppendedData")
    tag, _, block = rest.partition(b">")
    # Raw bytes are not XML, so the tree ends before them.
    root = ElementTree.fromstring(xml + b"</VTKFile>" if rest else xml)
    if root.tag != "VTKFile" or root.get("type") not in ("PolyData", "UnstructuredGrid", "StructuredGrid"):
        found = root.get("type", root.tag)
        raise InputError(f"expected polydata or a structured or unstructured grid of VTK, but found {found!r}.")
    compressor = root.get("compressor", "")
    if compressor and compressor not in libraries:
        raise InputError(f"the compression {compressor!r} is not read; use {' or '.join(libraries)}, or none.")
    order = ">" if root.get("byte_order") == "BigEndian" else "<"
    header = np.dtype(order + ("u8" if root.get("header_type") == "UInt64" else "u4"))
    return root, _VtkXml(
        order, header, libraries[compressor].decompress if compressor else None, block.partition(b"_")[2], b"raw" in tag
    )


def _piece(piece: ElementTree.Element, file: _VtkXml) -> Contents:
    found = [_values(array, file) for array in piece.iterfind("Points/DataArray")]
    # A structured grid has an extent instead of a number.
    count = piece.get("NumberOfPoints", f"{len(found[0])}" if found else "0")
    if len(found) != 1 or found[0].shape != (_whole(count), 3):
        raise InputError(f"a piece declares {count} points, but does not hold them.")
    data = next(piece.iterfind("PointData"), ElementTree.Element("none"))
    arrays = {array.get("Name", "unnamed"): _values(array, file) for array in data}
    faces = [no_faces(), *(_faces(piece, name, file) for name in ("Polys", "Strips", "Cells"))]
    unread = ["lines"] if _whole(piece.get("NumberOfLines")) else []
    unread += ["values of polygons"] if piece.findall("CellData/*") else []
    return assemble_contents(found[0].astype(np.float64), np.concatenate(faces), arrays, data.get("Normals"), unread)


def _whole(text: str | None) -> int:
    if text is not None and not text.strip().isdecimal():
        raise InputError(f"a count is {text[:20]!r}, but a whole number was expected.")
    return int(text or 0)


def _faces(piece: ElementTree.Element, name: str, file: _VtkXml) -> Int:
    arrays = {array.get("Name"): _values(array, file) for array in piece.iterfind(f"{name}/DataArray")}
    if not {"connectivity", "offsets"} <= arrays.keys():
        return no_faces()
    corners = arrays["connectivity"].astype(np.int64).ravel()
    ends = arrays["offsets"].astype(np.int64).ravel()
    counts = counts_from_offsets(np.concatenate([[0], ends]), corners)
    if "types" in arrays:
        kept = np.isin(arrays["types"], (5, 7, 9))  # triangles, polygons and quadrangles
        corners, counts = corners[np.repeat(kept, counts)], counts[kept]
    return fan_triangles(counts, corners, strips=name == "Strips")


def _values(array: ElementTree.Element, file: _VtkXml) -> Values:
    """Return an array of shape (N,), or (N, C) where it has C > 1 components."""
    kind = array.get("type", "")
    if re.fullmatch("U?Int(8|16|32|64)|Float(32|64)", kind) is None:
        raise InputError(f"the number type {kind[:40]!r} is unknown or not read.")
    dtype = np.dtype(kind.lower())
    form = array.get("format", "ascii")
    if form == "ascii":
        values = text_numbers((array.text or "").split(), dtype)
    else:
        values = np.frombuffer(_bytes(array, form, file), np.dtype(file.order + dtype.str[1:])).astype(dtype)
    columns = _whole(array.get("NumberOfComponents", "1"))
    return values if columns == 1 else values.reshape(-1, max(columns, 1))


def _bytes(array: ElementTree.Element, form: str, file: _VtkXml) -> bytes:
    """The bytes of an array; in base64, the header of compressed data is encoded separately."""
    if form not in ("appended", "binary"):
        raise InputError(f"the format {form[:20]!r} of an array is unknown.")
    if form == "appended":
        block = file.appended[_whole(array.get("offset")) :]
    else:
        block = "".join((array.text or "").split()).encode("ascii", "replace")
    raw, width = form == "appended" and file.raw, file.header.itemsize
    block = block if raw else block.lstrip()

    def first(size: int, after: int = 0) -> bytes:
        if raw:
            return block[after : after + size]
        # Three bytes take four characters.
        start, end = (-(-count // 3) * 4 for count in (after, size))
        return binascii.a2b_base64(block[start : start + end])[:size]

    def header(size: int) -> list[int]:
        data = first(size * width)
        if len(data) < size * width:
            raise InputError("the file ends within the header of an array.")
        found: list[int] = np.frombuffer(data, file.header, size).tolist()
        return found

    count = _require_plausible(header(1)[0], block)
    if file.decompress is None:
        data = first(width + count)[width:]
        if len(data) < count:
            raise InputError(f"an array declares {count} bytes, but {len(data)} follow.")
        return data
    # The number of blocks, the size of one, that of the last one, and what each takes when it is compressed.
    ends = np.cumsum([0, *header(3 + count)[3:]], dtype=np.int64).tolist()
    packed = first(_require_plausible(ends[-1], block), (3 + count) * width)
    return b"".join(file.decompress(packed[start:end]) for start, end in itertools.pairwise(ends))


def _require_plausible(count: int, data: bytes) -> int:
    """Refuse a number of blocks or bytes that is larger than the data itself."""
    if count > len(data):
        raise InputError("an array declares more than the file holds.")
    return count
