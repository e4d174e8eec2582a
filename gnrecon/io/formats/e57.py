"""E57, the ASTM's format of scans from several positions (E2807), read by the optional package pye57.

Each scan has a pose, a unit quaternion (w, x, y, z) and a translation, that moves it to common coordinates; the
translation is the scanner's position. Points are Cartesian or spherical (range, azimuth, elevation), and may be marked
as invalid. Lengths are metres. The file's pages have checksums, by which the library detects damage.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from gnrecon.geometry.arrays import Values
from gnrecon.io.column_names import COLOR
from gnrecon.io.contents import Contents, concatenated, from_columns, guard_parser
from gnrecon.runtime.errors import InputError


def read_e57(path: Path) -> Contents:
    """Read all scans in common coordinates, with the scanner's position for each point."""
    try:
        import pye57
    except ImportError:
        raise InputError("E57 files need the package pye57; install it with: pip install pye57") from None
    with guard_parser("E57"):
        file = pye57.E57(str(path))
        try:
            scans = [_scan(file, file.get_header(number)) for number in range(file.scan_count)]
        finally:
            file.close()
    if not scans:
        raise InputError("the file holds no scan.")
    return concatenated(scans)


def _scan(file: Any, header: Any) -> Contents:
    from pye57.utils import convert_spherical_to_cartesian

    fields = set(header.point_fields)
    cartesian = [f"cartesian{axis}" for axis in "XYZ"]
    spherical = ["sphericalRange", "sphericalAzimuth", "sphericalElevation"]
    position = next((names for names in (cartesian, spherical) if fields.issuperset(names)), None)
    if position is None:
        raise InputError("a scan has neither Cartesian nor spherical coordinates.")
    states, colors = ("cartesianInvalidState", "sphericalInvalidState"), [f"color{name.title()}" for name in COLOR]
    # Names of further fields and of the columns that they become, with the type of each.
    others = {f"nor:normal{axis}": (f"n{axis.lower()}", "f8") for axis in "XYZ"}
    others |= {name: (short, "f8") for name, short in zip(colors, COLOR, strict=True)}
    others |= {"intensity": ("intensity", "f8"), "rowIndex": ("row", "i4"), "columnIndex": ("column", "i4")}
    others |= {"returnIndex": ("return_number", "i4"), "timeStamp": ("time", "f8")}
    others = {name: held for name, held in others.items() if name in fields}
    types = dict.fromkeys(position, "f8") | {name: kind for name, (_, kind) in others.items()}
    values = _read(file, header, types | {name: "i1" for name in states if name in fields})
    valid = np.ones(header.point_count, bool)
    for name in fields.intersection(states):
        valid &= values.pop(name) == 0  # in state 1, only the direction is known
    values = {name: column[valid] for name, column in values.items()}
    points = np.column_stack([values[name] for name in position])
    points = points if position is cartesian else convert_spherical_to_cartesian(points)
    found = from_columns({label: values[name] for name, (label, _) in others.items()}, None, points)
    if "colors" in found.attributes:
        shades = {"colors": _colors(found.attributes["colors"], colors, header)}
        found = replace(found, attributes={**found.attributes, **shades})
    rotation, translation = np.asarray(header.rotation_matrix, np.float64), np.asarray(header.translation, np.float64)
    return found.moved(rotation, translation, translation if header.has_pose() else None)


def _read(file: Any, header: Any, types: dict[str, str]) -> dict[str, npt.NDArray[Any]]:
    """The fields of all points, as doubles or integers; the library applies the scale of scaled integers."""
    from pye57 import libe57

    values = {name: np.zeros(header.point_count, kind) for name, kind in types.items()}
    buffers = libe57.VectorSourceDestBuffer()
    for name, array in values.items():
        buffers.append(libe57.SourceDestBuffer(file.image_file, name, array, len(array), True, True))
    reader = header.points.reader(buffers)
    found = reader.read() if header.point_count else 0
    reader.close()
    if found != header.point_count:
        raise InputError(f"a scan declares {header.point_count} points, but {found} could be read.")
    return values


def _colors(values: Values, names: list[str], header: Any) -> Values:
    """Colours in 8 bits if the scan's limits, or else the colours themselves, are within 8 bits; else in 16 bits."""
    colors = np.rint(np.clip(np.nan_to_num(values.astype(np.float64)), 0, 65535)).astype(np.uint16)
    limit = colors.max(initial=0)
    if header.node.isDefined("colorLimits"):
        limits = header.node["colorLimits"]
        limit = max(limit, *(int(limits[f"{name}Maximum"].value()) for name in names))
    return colors.astype(np.uint8) if limit <= 255 else colors
