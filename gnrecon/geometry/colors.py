"""Conversion of colours between 8-bit sRGB, as files store it, and linear light, in which colours can be averaged.

sRGB values follow the eye's response, so their mean is darker than the mixture of the lights. The transfer curve is
that of IEC 61966-2-1: with s from 0 to 1, light is s / 12.92 up to s = 0.04045, and ((s + 0.055) / 1.055)^2.4 above.
Alpha has no such curve.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from gnrecon.geometry.arrays import Float, Values

Bytes = npt.NDArray[np.uint8]


def as_bytes(colors: Values) -> Bytes:
    """Return colours, of shape (N, 3 or 4), in 8 bits.

    Full brightness is 1 for floating-point values that are all within 0 to 1, 65535 for 16-bit integers and for values
    of which any exceeds 255, and otherwise 255.
    """
    if colors.dtype == np.uint8:
        return np.asarray(colors, dtype=np.uint8)
    values = np.nan_to_num(colors.astype(np.float64))
    largest = values.max(initial=0.0)
    if np.issubdtype(colors.dtype, np.floating) and largest <= 1:
        values = values * 255
    elif colors.dtype == np.uint16 or largest > 255:
        values = values / (65535 / 255)
    return np.rint(np.clip(values, 0, 255)).astype(np.uint8)


def to_linear(colors: Bytes) -> Float:
    """Return linear light from 0 to 1, and alpha as a share, for sRGB bytes of shape (N, 3 or 4)."""
    shares = colors / 255.0
    light = np.where(shares <= 0.04045, shares / 12.92, ((shares + 0.055) / 1.055) ** 2.4)
    return _with_alpha_of(light, shares)


def to_srgb(light: Float) -> Bytes:
    """Return sRGB bytes for linear light from 0 to 1, of shape (N, 3 or 4), clipped to that range."""
    light = np.clip(light, 0, 1)
    shares = np.where(light <= 0.04045 / 12.92, light * 12.92, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.rint(255 * _with_alpha_of(shares, light)).astype(np.uint8)


def with_alpha(colors: Bytes) -> Bytes:
    """Return colours of shape (N, 4); opaque where there is no alpha."""
    return colors if colors.shape[1] == 4 else np.hstack([colors, np.full((len(colors), 1), 255, np.uint8)])


def _with_alpha_of(colors: Float, source: Float) -> Float:
    return np.column_stack([colors[:, :3], source[:, 3:]])
