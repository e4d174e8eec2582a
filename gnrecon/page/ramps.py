"""Colour ramps for values on a surface, interpolated in Oklab.

Oklab (Ottosson 2020, "A perceptual color space for image processing") measures colours so that equal steps look
equal; a ramp that is straight between a few colours there neither bands nor hides differences. Sequential ramps rise in
lightness from zero; diverging ones are lightest in the middle, which is zero.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
import numpy.typing as npt

from gnrecon.geometry.arrays import Float
from gnrecon.geometry.colors import to_linear, to_srgb

STOPS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "diverging": ("#20428f", "#4f8cc9", "#b5d3e6", "#f3f1ec", "#efc3a4", "#d8704d", "#8f1d2c"),
        "curvature": ("#1c5c4c", "#55a88a", "#b9dccb", "#f4f2ea", "#dfc7e0", "#a878b5", "#582a72"),
        "uncertainty": ("#2b2a63", "#2f6f9f", "#38a99b", "#97cf6d", "#f6e451"),
        "distance": ("#e9e6df", "#f0c987", "#e98a4d", "#c2413f", "#6d1738"),
        "plain": ("#26305c", "#2f7f98", "#7cc08a", "#f4e58c"),
    }
)
"""Colours at equal steps, from the lowest value to the highest."""

SIZE = 256

# From linear sRGB to the responses of the eye's cones, and from their cube roots to Oklab.
_CONES = np.array(
    [
        [0.4122214708, 0.5363325363, 0.0514459929],
        [0.2119034982, 0.6806995451, 0.1073969566],
        [0.0883024619, 0.2817188376, 0.6299787005],
    ]
)
_LAB = np.array(
    [
        [0.2104542553, 0.7936177850, -0.0040720468],
        [1.9779984951, -2.4285922050, 0.4505937099],
        [0.0259040371, 0.7827717662, -0.8086757660],
    ]
)


def ramp(name: str) -> npt.NDArray[np.uint8]:
    """Return the sRGB colours of a ramp of `STOPS`, of shape (256, 3), from the lowest value to the highest."""
    colors = np.array([list(bytes.fromhex(color[1:])) for color in STOPS[name]], dtype=np.uint8)
    stops = _to_oklab(to_linear(colors))
    places = np.linspace(0, 1, SIZE)
    lab = np.stack([np.interp(places, np.linspace(0, 1, len(stops)), channel) for channel in stops.T], axis=1)
    return to_srgb(_from_oklab(lab))


def css(color: npt.NDArray[np.uint8]) -> str:
    """Return an sRGB colour of shape (3,) as style sheets write it."""
    return "#" + bytes(color).hex()


def _to_oklab(light: Float) -> Float:
    lab: Float = np.cbrt(light @ _CONES.T) @ _LAB.T
    return lab


def _from_oklab(lab: Float) -> Float:
    light: Float = (lab @ np.linalg.inv(_LAB).T) ** 3 @ np.linalg.inv(_CONES).T
    return light
