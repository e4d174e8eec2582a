"""PCD, the Point Cloud Library's format, by open3d's tensor reader.

That reader keeps doubles and all scalar fields (open3d's older one misreads binary doubles). But on failure it prints a
warning and returns an empty cloud, and it pads a short file with zeros. The amount of data is therefore compared with
the header before reading, and the number of points afterwards. A contradictory header would abort the process, so it is
refused here. Of a field of several numbers a point the reader keeps the first: such a field is read as one field for
each number, which is the same data. Padding (fields named ``_``, also of no bytes), names in upper case and the old
COLUMNS, which PCL and drivers of scanners write, are put into a header that the reader takes, over the same data; so
are normals, which it would misread where their type is not that of the positions.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from gnrecon.io.contents import Contents, from_columns
from gnrecon.io.parse import parse_numbers
from gnrecon.runtime.errors import InputError
from gnrecon.runtime.quiet_imports import import_open3d

Header = dict[str, list[str]]


def read_pcd(path: Path) -> Contents:
    """Read an ascii, binary or binary_compressed PCD."""
    open3d = import_open3d()

    header, body = _split(path.read_bytes())
    header, vectors = _with_single_fields(_plain(header))
    declared = int(header["POINTS"][0])
    _require_complete(header, body, declared)
    with (
        open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error),
        tempfile.NamedTemporaryFile(suffix=".pcd") as copy,
    ):
        lines = [" ".join([key, *words]) for key, words in header.items()]
        copy.write("\n".join([*lines, ""]).encode("utf-8") + body)
        copy.flush()
        cloud = open3d.t.io.read_point_cloud(Path(copy.name), format="pcd")
    arrays = {name: cloud.point[name].numpy() for name in cloud.point if not name.startswith("_")}
    points = arrays.pop("positions", np.empty((0, 3)))
    if len(points) != declared:
        raise InputError(f"the header declares {declared} points, but {len(points)} could be read.")
    arrays |= {name: values[:, 0] for name, values in arrays.items() if values.shape[1:] == (1,)}
    found = {name: np.stack([arrays.pop(part) for part in parts], axis=1) for name, parts in vectors.items() if parts}
    contents = from_columns({**arrays, **found}, None, points)
    unread = [f"all but the first number of the field {name}" for name, parts in vectors.items() if not parts]
    return replace(contents, unread=(*contents.unread, *unread))


def _split(data: bytes) -> tuple[Header, bytes]:
    """Return the header's words by key, and the data that follows it."""
    header: Header = {}
    start = 0
    while "DATA" not in header and start < len(data):
        end = data.find(b"\n", start) + 1 or len(data)
        words = data[start:end].decode("ascii", errors="replace").split()
        if words and not words[0].startswith("#"):
            words[0] = words[0].upper().replace("COLUMNS", "FIELDS")
            if words[0] in header:
                raise InputError(f"the PCD header has two lines {words[0][:20]}.")
            header[words[0]] = words[1:]
        start = end
    if "POINTS" not in header and all(header.get(key, ["?"])[0].isdecimal() for key in ("WIDTH", "HEIGHT")):
        header["POINTS"] = [str(int(header["WIDTH"][0]) * int(header["HEIGHT"][0]))]
    required = ("FIELDS", "SIZE", "TYPE", "WIDTH", "HEIGHT", "POINTS", "DATA")
    if missing := [key for key in required if not header.get(key)]:
        raise InputError(f"the PCD header lacks {' and '.join(missing)}.")
    if not {"x", "y", "z"} <= {name.lower() for name in header["FIELDS"]}:
        raise InputError(f"expected fields named x, y and z, but the header lists {' '.join(header['FIELDS'])}.")
    counts = ((key, word) for key in ("SIZE", "COUNT", "POINTS", "WIDTH", "HEIGHT") for word in header.get(key, []))
    if wrong := next(((key, word) for key, word in counts if not word.isdecimal()), None):
        raise InputError(f"the header's {wrong[0]} holds {wrong[1]!r}, but a count was expected.")
    return header, data[start:]


def _plain(header: Header) -> Header:
    """Return the header with names and types that the reader knows, each field once, and none that holds nothing."""
    counts = header.get("COUNT", ["1"] * len(header["FIELDS"]))
    columns = (header["FIELDS"], header["SIZE"], header["TYPE"], counts)
    if len({len(words) for words in columns}) > 1:
        raise InputError("the PCD header does not give a size, a type and a count for each field.")
    # The reader takes three fields normal_x, ... for one array of the first one's type, and writes beyond its end.
    known = {f"{prefix}{axis}": f"n{axis}" for axis in "xyz" for prefix in ("normal_", "normal")}
    known |= {name: name for name in ("x", "y", "z", "nx", "ny", "nz", "rgb", "rgba", "intensity")}
    fields = []
    for place, (name, size, kind, count) in enumerate(zip(*columns, strict=True)):
        title = f"_{place}" if name == "_" else known.get(name.lower(), name)
        single = title not in ("x", "y", "z", "rgb", "rgba") or (count == "1" and (title[0] != "r" or size == "4"))
        if kind.upper() not in "FIU" or size not in ("1248" if kind.upper() != "F" else "48") or not single:
            raise InputError(f"the PCD header has an invalid description of the field {name[:20]!r}.")
        if int(count):
            fields.append((title, size, kind.upper(), count))
    names, sizes, kinds, lengths = map(list, zip(*fields, strict=True))
    if len(set(names)) < len(names):
        raise InputError("the PCD header names a field twice.")
    if int(header["WIDTH"][0]) * int(header["HEIGHT"][0]) != int(header["POINTS"][0]):
        raise InputError("the PCD header's width and height do not give its number of points.")
    plain = {"FIELDS": names, "SIZE": sizes, "TYPE": kinds, "COUNT": lengths}
    first = {"VERSION": header.get("VERSION", ["0.7"]), **plain}
    last = {key: words for key, words in header.items() if key not in first and key != "DATA"}
    return {**first, **last, "DATA": [word.lower() for word in header["DATA"][:1]]}


def _with_single_fields(header: Header) -> tuple[Header, dict[str, list[str]]]:
    """Return the header with a field for each number of a point, and the names of those of each longer field.

    They are none in compressed data, where the numbers of a field lie together and no header separates them.
    """
    keys = ("FIELDS", "SIZE", "TYPE", "COUNT")
    fields: list[tuple[str, str, str, str]] = []
    vectors: dict[str, list[str]] = {}
    for name, size, kind, count in zip(*(header[key] for key in keys), strict=True):
        parts = [name]
        if int(count) > 1 and not name.startswith("_"):
            vectors[name] = (
                [] if header["DATA"] == ["binary_compressed"] else [f"{name}[{i}]" for i in range(int(count))]
            )
            parts = vectors[name] or parts
        fields += [(part, size, kind, "1" if len(parts) > 1 else count) for part in parts]
    return header | {key: list(words) for key, words in zip(keys, zip(*fields, strict=True), strict=True)}, vectors


def _require_complete(header: Header, body: bytes, points: int) -> None:
    """Refuse data that is shorter than the header declares."""
    counts = [int(word) for word in header["COUNT"]]
    row = sum(int(size) * count for size, count in zip(header["SIZE"], counts, strict=True))
    match header["DATA"][0]:
        case "ascii":
            found = len(parse_numbers(body.decode("ascii", errors="replace").split())) // max(sum(counts), 1)
        case "binary":
            found = len(body) // max(row, 1)
        case "binary_compressed":
            # Compressed data begins with its own size and that of the unpacked data.
            packed, unpacked = np.frombuffer(body[:8], "<u4").tolist() if len(body) >= 8 else (0, 0)
            found = unpacked // max(row, 1) if packed <= len(body) - 8 else 0
        case other:
            raise InputError(f"the PCD encoding {other!r} is unknown.")
    if found < points:
        raise InputError(f"the header declares {points} points, but the file ends after {found}.")
