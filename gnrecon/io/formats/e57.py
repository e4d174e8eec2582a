"""E57, the ASTM's format of scans from several positions (E2807), by pye57, which is an extra.

Each scan has a pose, a unit quaternion (w, x, y, z) and a translation, that moves it to common coordinates; its
translation is where the scanner stood. Points are Cartesian or spherical (range, azimuth, elevation); the file says
which of them are invalid. Lengths are metres. The file's pages carry checksums, so that damage is found by the library.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from gnrecon.geometry.arrays import Float, Values
from gnrecon.io.contents import Columns, Contents, joined, no_faces, parsing
from gnrecon.runtime.errors import InputError

_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
_NORMAL = ("nor:normalX", "nor:normalY", "nor:normalZ")
_COLOR = ("colorRed", "colorGreen", "colorBlue")
_OTHERS = {
    "intensity": ("intensity", "f8"),
    "rowIndex": ("row", "i4"),
    "columnIndex": ("column", "i4"),
    "returnIndex": ("return_number", "i4"),
    "timeStamp": ("time", "f8"),
}
"""Names of further fields, here and as attributes, with the type of each."""

_STATES = ("cartesianInvalidState", "sphericalInvalidState")


def read_e57(path: Path) -> Contents:
    """Read all scans in common coordinates, with the scanner's position for each point.

    Raises
    ------
    InputError
        When pye57 is not installed, or the file is malformed or holds no scan.
    """
    try:
        import pye57
    except ImportError:
        raise InputError("E57 files need the package pye57; install it with: pip install pye57") from None
    with parsing("E57"):
        file = pye57.E57(str(path))
        try:
            scans = [_scan(file, file.get_header(number)) for number in range(file.scan_count)]
        finally:
            file.close()
    if not scans:
        raise InputError("the file holds no scan.")
    return joined(scans)


def _scan(file: Any, header: Any) -> Contents:
    fields = set(header.point_fields)
    place = next((names for names in (_CARTESIAN, _SPHERICAL) if fields.issuperset(names)), None)
    if place is None:
        raise InputError("a scan has neither Cartesian nor spherical coordinates.")
    kinds = dict.fromkeys(place, "f8")
    kinds |= dict.fromkeys(_NORMAL, "f8") if fields.issuperset(_NORMAL) else {}
    kinds |= dict.fromkeys(_COLOR, "f8") if fields.issuperset(_COLOR) else {}
    kinds |= {name: kind for name, (_, kind) in _OTHERS.items() if name in fields}
    kinds |= {name: "i1" for name in _STATES if name in fields}
    values = _read(file, header, kinds)
    valid = np.ones(header.point_count, bool)
    for name in _STATES:
        # Of state 1, only the direction is known.
        valid &= values.pop(name, np.zeros(len(valid), np.int8)) == 0
    return _contents({name: one[valid] for name, one in values.items()}, place, header)


def _read(file: Any, header: Any, kinds: dict[str, str]) -> dict[str, npt.NDArray[Any]]:
    """The fields of all points, as doubles or integers; scaled integers come as the numbers that they stand for."""
    from pye57 import libe57

    values = {name: np.zeros(header.point_count, kind) for name, kind in kinds.items()}
    buffers = libe57.VectorSourceDestBuffer()
    for name, array in values.items():
        buffers.append(libe57.SourceDestBuffer(file.image_file, name, array, len(array), True, True))
    reader = header.points.reader(buffers)
    found = reader.read() if header.point_count else 0
    reader.close()
    if found != header.point_count:
        raise InputError(f"a scan declares {header.point_count} points, but {found} could be read.")
    return values


def _contents(values: dict[str, npt.NDArray[Any]], place: tuple[str, ...], header: Any) -> Contents:
    own = np.column_stack([values[name] for name in place])
    own = own if place is _CARTESIAN else _from_spherical(own)
    rotation, translation = np.asarray(header.rotation_matrix, np.float64), np.asarray(header.translation, np.float64)
    normals = None
    if _NORMAL[0] in values:
        normals = np.column_stack([values[name] for name in _NORMAL]) @ rotation.T
    attributes: dict[str, Values] = dict(_colors(values, header))
    attributes |= {label: values[name] for name, (label, _) in _OTHERS.items() if name in values}
    points = own @ rotation.T + translation
    origins = np.broadcast_to(translation, points.shape) if header.has_pose() else None
    return Contents(points, normals, no_faces(), attributes, (), origins)


def _from_spherical(rows: Float) -> Float:
    distance, azimuth, elevation = rows.T
    flat = distance * np.cos(elevation)
    return np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), distance * np.sin(elevation)])


def _colors(values: Columns, header: Any) -> Columns:
    """Colours in 8 bits if the scan's limits, or else the colours themselves, are within 8 bits; else in 16 bits."""
    if _COLOR[0] not in values:
        return {}
    colors = np.column_stack([values[name] for name in _COLOR]).astype(np.float64)
    colors = np.rint(np.clip(np.nan_to_num(colors), 0, 65535)).astype(np.uint16)
    limit = colors.max(initial=0)
    if header.node.isDefined("colorLimits"):
        limits = header.node["colorLimits"]
        limit = max(limit, *(int(limits[f"{name}Maximum"].value()) for name in _COLOR))
    return {"colors": colors.astype(np.uint8) if limit <= 255 else colors}
