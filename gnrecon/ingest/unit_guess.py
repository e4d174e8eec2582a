"""Guess of a scan's unit, with its reason, because few formats store one.

E57, PTX and glTF are in metres by their definitions, and LAS nearly always is. Projected coordinates are in metres too.
Elsewhere there is only the size: most scanned objects are between a few millimetres and a few metres long.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from gnrecon.geometry.arrays import Float

METRIC_FORMATS = {".e57": "E57", ".ptx": "PTX", ".gltf": "glTF", ".glb": "glTF", ".las": "LAS", ".laz": "LAZ"}
"""Extensions of formats that are in metres, and their names."""


@dataclass(frozen=True)
class UnitsGuess:
    """A unit of `gnrecon.geometry.units.METRES`, or None where there is no indication, and the reason."""

    unit: str | None
    reason: str

    def as_dict(self) -> dict[str, str | None]:
        """Return the fields by name."""
        return asdict(self)


def guess_units(
    lower: Sequence[float],
    upper: Sequence[float],
    files: Sequence[str] = (),
    *,
    projected_position: float = 1e4,
    projected_ratio: float = 30.0,
    smallest: float = 0.005,
    largest_in_metres: float = 5.0,
    largest_in_mm: float = 5000.0,
) -> UnitsGuess:
    """Guess the unit of a scan.

    Parameters
    ----------
    lower, upper : corners of its bounding box
    files : that it was read from
    projected_position : least distance of projected coordinates from the origin; map grids count from 1e5 and more
    projected_ratio : least ratio of that distance to the scan's size
    smallest, largest_in_metres, largest_in_mm : limits of the longest side: from 0.005 to 5 it is taken for metres, and
        up to 5000 for millimetres, so that objects between 5 mm and 5 m are guessed correctly
    """
    named = {METRIC_FORMATS.get(_extension(file)) for file in files}
    if len(named) == 1 and (name := named.pop()) is not None:
        usual = "usually" if name.startswith("LA") else "by definition"
        return UnitsGuess("m", f"{name} files are {usual} in metres")
    low, high = np.asarray(lower), np.asarray(upper)
    longest, place = float((high - low).max()), float(np.abs(low + high).max() / 2)
    if place > max(projected_position, projected_ratio * longest):
        return UnitsGuess("m", f"coordinates around {place:,.0f} look like projected ones")
    if _normalised(low, high):
        return UnitsGuess(None, "the shape seems to be scaled to a unit box or ball")
    if smallest < longest <= largest_in_metres:
        return UnitsGuess("m", f"its longest side would be {1000 * longest:,.4g} mm, a usual size")
    if largest_in_metres < longest <= largest_in_mm:
        return UnitsGuess("mm", f"its longest side would be {longest:.4g} mm, a usual size")
    return UnitsGuess(None, f"its longest side, {longest:.3g}, is unusual in mm and in m")


def _extension(file: str) -> str:
    """Return the extension in lower case, without that of compression."""
    path = Path(file)
    return (path.with_suffix("") if path.suffix.lower() == ".gz" else path).suffix.lower()


def _normalised(low: Float, high: Float, *, tolerance: float = 5e-3) -> bool:
    """Return whether the box has side 1 or 2 and is centred, or has its corner, at the origin.

    `tolerance` is the relative error of the side, or that of the corner's position.
    """
    longest = float((high - low).max())
    centred = float(np.abs(low + high).max()) < 0.5 * longest
    sizes = [abs(longest - side) < tolerance * side for side in (1.0, 2.0)]
    return any(sizes) and (centred or float(np.abs(low).max()) < tolerance)
