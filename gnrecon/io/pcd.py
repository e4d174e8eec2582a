"""PCD, the Point Cloud Library's format, by open3d's tensor reader.

That reader keeps doubles and all scalar fields (open3d's older one misreads binary doubles). But it reports failures by
printing a warning and returning an empty cloud, and fills up what a short file lacks with zeros. So the amount of data
is compared with the header before, and the number of points after.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from gnrecon.errors import InputError
from gnrecon.io.contents import Contents, no_faces
from gnrecon.io.text import numbers

Header = dict[str, list[str]]

_KEYS = ("FIELDS", "SIZE", "TYPE", "WIDTH", "HEIGHT", "POINTS", "DATA")


def read_pcd(path: Path) -> Contents:
    """Read an ascii, binary or binary_compressed PCD.

    Raises
    ------
    InputError
        When the header is malformed or fewer points than it declares can be read.
    """
    import open3d

    header, body = _split(path.read_bytes())
    declared = int(header["POINTS"][0])
    _require_all(header, body, declared)
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        cloud = open3d.t.io.read_point_cloud(path, format="pcd")
    arrays: dict[str, npt.NDArray[np.generic]] = {name: cloud.point[name].numpy() for name in cloud.point}
    points = arrays.pop("positions", np.empty((0, 3)))
    if len(points) != declared:
        raise InputError(f"the header declares {declared} points, but {len(points)} could be read.")
    normals = arrays.pop("normals", None)
    columns = {name: values[:, 0] if values.shape[1:] == (1,) else values for name, values in arrays.items()}
    return Contents(
        points.astype(np.float64), None if normals is None else normals.astype(np.float64), no_faces(), columns
    )


def _split(data: bytes) -> tuple[Header, bytes]:
    """Return the header's words by key, and the data behind it."""
    header: Header = {}
    start = 0
    while "DATA" not in header and start < len(data):
        end = data.find(b"\n", start) + 1 or len(data)
        words = data[start:end].decode("ascii", errors="replace").split()
        if words and not words[0].startswith("#"):
            header[words[0].upper()] = words[1:]
        start = end
    missing = [key for key in _KEYS if not header.get(key)]
    if missing:
        raise InputError(f"the PCD header lacks {' and '.join(missing)}.")
    if not {"x", "y", "z"} <= set(header["FIELDS"]):
        raise InputError(f"expected fields named x, y and z, but the header lists {' '.join(header['FIELDS'])}.")
    for key in ("SIZE", "COUNT", "POINTS"):
        for word in header.get(key, []):
            if not word.isdecimal():
                raise InputError(f"the header's {key} holds {word!r}, but a count was expected.")
    return header, data[start:]


def _require_all(header: Header, body: bytes, points: int) -> None:
    """Refuse data of another size than the header declares."""
    counts = [int(word) for word in header.get("COUNT", ["1"] * len(header["SIZE"]))]
    row = sum(int(size) * count for size, count in zip(header["SIZE"], counts, strict=True))
    match header["DATA"][0]:
        case "ascii":
            found = len(numbers(body.decode("ascii", errors="replace").split())) // max(sum(counts), 1)
        case "binary":
            found = len(body) // max(row, 1)
        case "binary_compressed":
            packed, unpacked = np.frombuffer(body[:8], "<u4").tolist() if len(body) >= 8 else (0, 0)
            found = unpacked // max(row, 1) if packed <= len(body) - 8 else 0
        case other:
            raise InputError(f"the PCD encoding {other!r} is unknown.")
    if found < points:
        raise InputError(f"the header declares {points} points, but the file ends after {found}.")
