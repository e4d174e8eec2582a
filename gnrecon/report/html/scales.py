"""Numbers as text with few digits and grouped thousands, marks of axes at round numbers, and colour ramps."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cache
from itertools import pairwise
from types import MappingProxyType

import numpy as np
import numpy.typing as npt

from gnrecon.geometry.arrays import Float
from gnrecon.geometry.colors import to_linear, to_srgb


def typographic(number: str) -> str:
    """Return the text of a number with a true minus sign."""
    return number.replace("-", "\N{MINUS SIGN}")


def count(number: float) -> str:
    """Return a whole number with grouped thousands."""
    return typographic(f"{round(number):,}")


def figure(number: float, digits: int = 3) -> str:
    """Return a number with some significant digits, by a power of ten where it is very large or very small."""
    if not math.isfinite(number):
        return "not finite"
    if number == 0:
        return "0"
    # The exponent is that of the rounded number, because rounding may carry.
    mantissa, _, power = f"{number:.{digits - 1}e}".partition("e")
    exponent = int(power)
    if -4 <= exponent < 7:
        text = f"{number:,.{max(0, digits - 1 - exponent)}f}"
    else:
        raised = str(exponent).translate(str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻"))
        text = f"{mantissa} \N{MULTIPLICATION SIGN} 10{raised}"
    return typographic(text)


def seconds(number: float) -> str:
    """Return a time in seconds, or in minutes and seconds."""
    if number < 60:
        return f"{number:.1f} s"
    minutes, rest = divmod(round(number), 60)
    return f"{minutes} min {rest} s"


def share(part: float, whole: float) -> str:
    """Return a part in percent of the whole."""
    percent = 100 * part / whole if whole else 0.0
    if 0 < percent < 0.1:
        return "< 0.1 %"
    return f"{percent:.1f} %" if percent < 99.95 or part == whole else "> 99.9 %"


def memory(megabytes: float) -> str:
    """Return an amount of memory."""
    return f"{megabytes / 1000:.2f} GB" if megabytes >= 1000 else f"{megabytes:.0f} MB"


STOPS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "diverging": ("#20428f", "#4f8cc9", "#b5d3e6", "#f3f1ec", "#efc3a4", "#d8704d", "#8f1d2c"),
        "curvature": ("#1c5c4c", "#55a88a", "#b9dccb", "#f4f2ea", "#dfc7e0", "#a878b5", "#582a72"),
        "uncertainty": ("#2b2a63", "#2f6f9f", "#38a99b", "#97cf6d", "#f6e451"),
        "distance": ("#e9e6df", "#f0c987", "#e98a4d", "#c2413f", "#6d1738"),
        "plain": ("#26305c", "#2f7f98", "#7cc08a", "#f4e58c"),
    }
)
"""Colours at equal steps. Sequential ramps change in lightness throughout; diverging ones are lightest at zero."""


def ramp(name: str, *, size: int = 256) -> npt.NDArray[np.uint8]:
    """Return the sRGB colours of a ramp of `STOPS`, of shape (size, 3), from the lowest value to the highest.

    Colours are interpolated in Oklab (Ottosson 2020, "A perceptual color space for image processing"), where equal
    steps look equal, so that a ramp neither bands nor hides differences.
    """
    colors = np.array([list(bytes.fromhex(color[1:])) for color in STOPS[name]], dtype=np.uint8)
    stops = _to_oklab(to_linear(colors))
    places = np.linspace(0, 1, size)
    lab = np.stack([np.interp(places, np.linspace(0, 1, len(stops)), channel) for channel in stops.T], axis=1)
    return to_srgb(_from_oklab(lab))


def css(color: npt.NDArray[np.uint8]) -> str:
    """Return an sRGB colour of shape (3,) as style sheets write it."""
    return "#" + bytes(color).hex()


def _to_oklab(light: Float) -> Float:
    cones, opponents = _oklab_matrices()
    lab: Float = np.cbrt(light @ cones.T) @ opponents.T
    return lab


def _from_oklab(lab: Float) -> Float:
    cones, opponents = _oklab_matrices()
    light: Float = (lab @ np.linalg.inv(opponents).T) ** 3 @ np.linalg.inv(cones).T
    return light


@cache
def _oklab_matrices() -> tuple[Float, Float]:
    """From linear sRGB to the responses of the eye's cones, and from their cube roots to Oklab; Ottosson 2020."""
    cones = [
        [0.4122214708, 0.5363325363, 0.0514459929],
        [0.2119034982, 0.6806995451, 0.1073969566],
        [0.0883024619, 0.2817188376, 0.6299787005],
    ]
    opponents = [
        [0.2104542553, 0.7936177850, -0.0040720468],
        [1.9779984951, -2.4285922050, 0.4505937099],
        [0.0259040371, 0.7827717662, -0.8086757660],
    ]
    return np.array(cones), np.array(opponents)


def linear(low: float, high: float, most: int = 5) -> list[float]:
    """Return at most `most` multiples of 1, 2 or 5 times a power of ten that lie between `low` and `high`."""
    rough = (high - low) / most
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(factor * power for factor in (1, 2, 5, 10, 20) if _count(low, high, factor * power) <= most)
    first = math.ceil(low / step - 1e-9)
    return [index * step for index in range(first, first + _count(low, high, step))]


def decades(low: float, high: float, most: int = 6) -> list[int]:
    """Return the powers of ten, at most `most` and evenly spaced, that lie between positive `low` and `high`."""
    first, last = math.ceil(math.log10(low) - 1e-9), math.floor(math.log10(high) + 1e-9)
    return list(range(first, last + 1, max(1, -(-(last - first + 1) // most))))


def labels(places: list[float]) -> list[str]:
    """Return the marks' numbers, all with the same decimals: those that their step needs."""
    step = min((after - before for before, after in pairwise(places)), default=0) or 1.0
    digits = max(0, -math.floor(math.log10(step) + 1e-9))
    if digits > 5 or max(map(abs, places), default=0) >= 1e6:
        return [typographic(f"{place:.1e}") for place in places]
    return [typographic(f"{place:,.{digits}f}") for place in places]


def _count(low: float, high: float, step: float) -> int:
    return math.floor(high / step + 1e-9) - math.ceil(low / step - 1e-9) + 1
