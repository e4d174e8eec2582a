"""Which unit a scan's coordinates may be in: a guess, with its reason, because few formats say it.

E57, PTX and glTF are in metres by their definitions, and LAS nearly always is. Projected coordinates are metres too.
Elsewhere only the size speaks: most things that are scanned are between a few millimetres and a few metres long.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from gnrecon.geometry.arrays import Float

_METRES = {".e57": "E57", ".ptx": "PTX", ".gltf": "glTF", ".glb": "glTF", ".las": "LAS", ".laz": "LAZ"}
_FAR, _FAR_SHARE = 1e4, 30.0
_UNIT = 5e-3
_SMALLEST, _MIDDLE, _LARGEST = 0.005, 5.0, 5000.0


@dataclass(frozen=True)
class UnitsGuess:
    """A unit, a name of `gnrecon.geometry.units.METRES` or None where there is nothing to go by, and why it is that."""

    unit: str | None
    reason: str

    def as_dict(self) -> dict[str, str | None]:
        """Return the fields by name."""
        return asdict(self)


def guess_units(lower: Sequence[float], upper: Sequence[float], files: Sequence[str] = ()) -> UnitsGuess:
    """Guess the unit of a scan.

    Parameters
    ----------
    lower, upper : corners of its box
    files : that it was read from
    """
    named = {_METRES.get(_extension(file)) for file in files}
    if len(named) == 1 and (name := named.pop()) is not None:
        usual = "usually" if name.startswith("LA") else "by definition"
        return UnitsGuess("m", f"{name} files are {usual} in metres")
    low, high = np.asarray(lower), np.asarray(upper)
    longest, place = float((high - low).max()), float(np.abs(low + high).max() / 2)
    if place > max(_FAR, _FAR_SHARE * longest):
        return UnitsGuess("m", f"coordinates about {place:,.0f} look like projected ones")
    if _normalised(low, high):
        return UnitsGuess(None, "the shape seems to have been scaled to a unit box or ball")
    if _SMALLEST < longest <= _MIDDLE:
        return UnitsGuess("m", f"its longest side, {longest:.3g}, would be {1000 * longest:,.4g} mm then")
    if _MIDDLE < longest <= _LARGEST:
        return UnitsGuess("mm", f"its longest side would be {longest:.4g} mm then, as of most things that are scanned")
    return UnitsGuess(None, f"its longest side, {longest:.3g}, is not like that of most things in mm or m")


def _extension(file: str) -> str:
    path = Path(file)
    return (path.with_suffix("") if path.suffix.lower() == ".gz" else path).suffix.lower()


def _normalised(low: Float, high: Float) -> bool:
    """Whether the box is one about the origin, or in its corner, that programs scale shapes to."""
    longest = float((high - low).max())
    centred = float(np.abs(low + high).max()) < 0.5 * longest
    sizes = [abs(longest - side) < _UNIT * side for side in (1.0, 2.0)]
    return any(sizes) and (centred or float(np.abs(low).max()) < _UNIT)
