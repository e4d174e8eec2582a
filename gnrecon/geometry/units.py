"""Parsers for lengths, shares, boxes and planes in options.

A plain number is in the file's unit; to convert a length with a unit, the file's own unit must be known.
"""

from __future__ import annotations

import math
import re

from gnrecon.runtime.errors import UsageError

METRES = {"um": 1e-6, "mm": 1e-3, "cm": 1e-2, "m": 1.0, "km": 1e3, "in": 0.0254, "ft": 0.3048}


def parse_length(text: str, units: str | None, *, least: float = 1e-30, most: float = 1e30) -> float:
    """Return a length in the file's unit.

    Parameters
    ----------
    text : such as ``2mm``, ``-0.5`` or ``1e-3 m``
    units : the file's unit, a name of `METRES`, or None where it is unknown
    least, most : magnitudes of lengths other than zero; squares and cubes of others under- or overflow

    Raises
    ------
    UsageError
        When `text` is not a length or out of range, a unit is not supported, or the file's unit is needed but unknown.
    """
    if units is not None and units not in METRES:
        raise UsageError(f"The file's unit must be one of {', '.join(METRES)}, not {units!r}.")
    match = re.fullmatch(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?)\s*([a-z]*)\s*", text, re.IGNORECASE)
    if match is None or not math.isfinite(float(match[1])):
        raise UsageError(f"{text!r} is not a length such as 0.5 or 2mm.")
    _require_magnitude(text, float(match[1]), least, most)
    suffix = match[2].lower()
    if not suffix:
        return float(match[1])
    if suffix not in METRES:
        raise UsageError(f"{text!r} has an unknown unit; use one of {', '.join(METRES)}, or a plain number.")
    if units is None:
        raise UsageError(f"{text!r} needs the file's own unit to be converted: add --units, such as --units mm.")
    return float(match[1]) * (METRES[suffix] / METRES[units])


def _require_magnitude(text: str, value: float, least: float, most: float) -> None:
    if value and not least <= abs(value) <= most:
        raise UsageError(f"{text!r} is out of range: a length lies between {least:g} and {most:g}.")


def parse_reach(
    text: str, spacing: float, units: str | None, *, least_spacings: float = 1e-30, most_spacings: float = 1e30
) -> float:
    """Return a positive distance in the file's unit, from a length or a multiple of the points' spacing.

    Parameters
    ----------
    text : such as ``2.5``, ``2mm``, or ``3s`` for three spacings
    spacing : of the points, in the file's unit
    units : as of `parse_length`
    least_spacings, most_spacings : range of multiples

    Raises
    ------
    UsageError
        When it is not a positive length, out of range, or cannot be converted.
    """
    match = re.fullmatch(r"\s*\+?((?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?)\s*s\s*", text, re.IGNORECASE)
    if match:
        _require_magnitude(text, float(match[1]), least_spacings, most_spacings)
    reach = float(match[1]) * spacing if match else parse_length(text, units)
    if not 0 < reach < math.inf:
        raise UsageError(f"{text!r} is not a positive distance such as 2.5, 2mm or 3s (spacings).")
    return reach


def parse_share(name: str, value: float | str) -> float:
    """Return a share of the points as a number, from a number or a percentage.

    Parameters
    ----------
    name : of the option
    value : such as 0.2, ``"0.2"`` or ``"20%"``

    Raises
    ------
    UsageError
        When it is no number, or not in (0, 1].
    """
    number, percent, _ = value.partition("%") if isinstance(value, str) else (value, "", "")
    try:
        share = float(number) / (100 if percent else 1)
    except ValueError:
        raise UsageError(f"{name} must be a share such as 0.2 or 20%, not {value!r}.") from None
    if not 0 < share <= 1:
        likely = (
            f"; for {share:g} percent, give {share / 100:g} or {share:g}%" if 1 < share <= 100 and not percent else ""
        )
        raise UsageError(f"The {name} of points is {value}, but must lie in (0, 1]{likely}.")
    return share


def parse_box(text: str) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Return the lower and the upper corner of a box written as six numbers ``xmin,ymin,zmin,xmax,ymax,zmax``.

    Raises
    ------
    UsageError
        When these are not six finite numbers, or an upper one does not exceed its lower one.
    """
    try:
        x, y, z, u, v, w = (float(part) for part in text.split(","))
    except ValueError:
        raise UsageError(f"{text!r} is not a box: six numbers xmin,ymin,zmin,xmax,ymax,zmax are expected.") from None
    if not all(map(math.isfinite, (x, y, z, u, v, w))) or not (x < u and y < v and z < w):
        raise UsageError(f"{text!r} is not a box: its lower corner must come first, and each side have some length.")
    return (x, y, z), (u, v, w)


def parse_plane(text: str) -> tuple[float, float, float, float]:
    """Return the numbers a, b, c and d of a plane a x + b y + c z + d = 0, written as ``a,b,c,d``.

    Raises
    ------
    UsageError
        When these are not four finite numbers, or the first three are all zero.
    """
    try:
        a, b, c, d = (float(part) for part in text.split(","))
    except ValueError:
        raise UsageError(f"{text!r} is not a plane: four numbers a,b,c,d are expected.") from None
    if not all(map(math.isfinite, (a, b, c, d))) or not any((a, b, c)):
        raise UsageError(f"{text!r} is not a plane: its numbers must be finite, and a,b,c not all zero.")
    return a, b, c, d
