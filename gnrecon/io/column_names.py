"""What a column holds, by its name as programs, surveyors and scanners write it: position, normal or colour.

Names are compared without case, quotes, units and punctuation, so that ``"X [mm]"``, ``x_coord``, ``Points:0`` and
``Easting`` all name the x axis.
"""

from __future__ import annotations

import re
from collections.abc import Iterable

from gnrecon.runtime.errors import InputError, UsageError

POSITION, NORMAL, COLOR = ("x", "y", "z"), ("nx", "ny", "nz"), ("red", "green", "blue")

_UNIT = r"mm|millimet(?:er|re)s?|cm|m|met(?:er|re)s?|km|ft|feet|us_?ft|in|inch(?:es)?"
_PLACE = (
    r"pos|positions?|points?|points_m_xyz|[ck]o[oö]rd[^\W_]*|坐标|location|loc|vertex|p|world|global|local|utm|grid|"
    r"field|cartesian|xyz"
)
_SURVEY = {
    "x": r"(?:(?:utm|grid|local|x)_?)?(?:e|east|easting|ost|ostwert|este?|rechts|rechtswert)",
    "y": r"(?:(?:utm|grid|local|y)_?)?(?:n|north|northing|nord|nordwert|norte|hoch|hochwert)",
    "z": r"(?:z_?)?(?:h|height|elevation|elev|altitude|alt|rl|hoehe|höhe|hoogte|cota|quota|altura|kote)",
}
_NAMES: dict[str, tuple[str, ...]] = {
    **{
        axis: (axis, rf"(?:{_PLACE})_?(?:{axis}|{place})|{axis}_?(?:{_PLACE}|value)", _SURVEY[axis])
        for place, axis in enumerate("xyz")
    },
    **{
        f"n{axis}": (f"n{axis}", rf"(?:normals?|norm|n)_?(?:{axis}|{place})|{axis}_?normal|normal_?n{axis}")
        for place, axis in enumerate("xyz")
    },
    **{
        color: (color, color[0], rf"diffuse_{color}|(?:colou?rs?|rgba?)_?(?:{color}|{color[0]}|{place})|{color[0]}f")
        for place, color in enumerate((*COLOR, "alpha"))
    },
}
"""Regular expressions for the names of each role, from the plainest to the least."""


def simple_name(name: str) -> str:
    """Return a name in lower case, without quotes, units and punctuation: ``'"X [mm]"'`` becomes ``'x'``."""
    name = re.sub(r"[\[(]\s*(\d+)\s*[\])]", r"_\1", name.strip().lower())
    name = re.sub(r"[^\w]+", "_", re.sub(r"\[.*?\]|\(.*?\)", "", name)).strip("_")
    return re.sub(rf"(?<=.)_(?:{_UNIT})$", "", name)


def is_angle(name: str) -> bool:
    """Whether a column is named as a latitude or a longitude."""
    return re.match("lat|lon|(?:geo)?breite|l(?:ä|ae)nge", simple_name(name)) is not None


def unit_of(name: str) -> str:
    """Return the unit in a column's name, such as ``mm`` of ``x [mm]`` or ``x_mm``; empty where there is none."""
    found = re.search(rf"[\[(]\s*({_UNIT})\s*[\])]|_({_UNIT})\W*$", name.strip().lower())
    return (found[1] or found[2]) if found else ""


def columns_of_role(names: Iterable[str], role: tuple[str, ...]) -> list[str] | None:
    """Return the names of the columns that make up a role, such as `POSITION`; None where one is missing.

    Names of one style go before names of several: with ``x, y, z, easting``, the first three are the position.
    """
    simple: dict[str, str] = {}
    for name in names:
        simple.setdefault(simple_name(name), name)

    def named(pattern: str) -> str:
        return next((name for key, name in simple.items() if re.fullmatch(pattern, key)), "")

    found = [[named(pattern) for pattern in _NAMES[part]] for part in role]
    mixed = [next(filter(None, choices), "") for choices in found] if role == POSITION else [""]
    return next((list(names) for names in (*zip(*found, strict=True), mixed) if all(names)), None)


def parse_columns(text: str | None) -> tuple[str, ...]:
    """Return the names in ``x,y,z,nx,ny,nz,-``, the option ``--columns``; none for None.

    `UsageError` is raised when x, y or z is missing, or a name comes twice.
    """
    names = tuple(name.strip() for name in text.split(",")) if text is not None else ()
    read = [name for name in names if name != "-"]
    if text is not None and (columns_of_role(read, POSITION) is None or len(set(read)) < len(read)):
        raise UsageError(f"The columns are names with x, y and z, each once, and - to skip one, not {text!r}.")
    return names


def require_position(names: Iterable[str], hint: str = "") -> list[str]:
    """Return the names of the columns of x, y and z; `InputError` is raised when one is missing, or units differ."""
    names = list(names)
    position = columns_of_role(names, POSITION)
    if position is None:
        shown = ", ".join(names)[:200] or "none"
        if any(map(is_angle, names)):
            hint = " Latitude and longitude are angles: project them to metres first."
        raise InputError(f"expected columns named x, y and z, but found {shown}.{hint}")
    units = [unit_of(name) for name in position]
    if len({unit for unit in units if unit}) > 1:
        raise InputError(f"the columns {', '.join(position)} differ in their units; write all of them in one unit.")
    return position
