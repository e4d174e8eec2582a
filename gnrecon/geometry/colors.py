"""Colours as numbers: 8-bit sRGB as files hold it, and linear light, in which alone colours may be averaged.

sRGB bytes grow about as the eye's response does, so that their mean is darker than the mixture of the lights. The two
are related by the curve of IEC 61966-2-1: linear near black, a power of 2.4 above. Alpha has no such curve.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from gnrecon.geometry.arrays import Float, Values

Bytes = npt.NDArray[np.uint8]

_KNEE = 0.04045
"""Where the curve of sRGB, from 0 to 1, turns from a line into a power."""

_FULL_16 = 65535 / 255


def as_bytes(colors: Values) -> Bytes:
    """Return colours, of shape (N, 3 or 4), in 8 bits, whichever way a file held them.

    Floating-point numbers that are all within 0 to 1 are shares of full brightness. Otherwise 255 is full, or 65535
    where there are 16-bit numbers or any larger than 255.
    """
    if colors.dtype == np.uint8:
        return np.asarray(colors, dtype=np.uint8)
    values = np.nan_to_num(colors.astype(np.float64))
    most = values.max(initial=0.0)
    if np.issubdtype(colors.dtype, np.floating) and most <= 1:
        values = values * 255
    elif colors.dtype == np.uint16 or most > 255:
        values = values / _FULL_16
    return np.rint(np.clip(values, 0, 255)).astype(np.uint8)


def to_linear(colors: Bytes) -> Float:
    """Return linear light from 0 to 1, and alpha as a share, for sRGB bytes of shape (N, 3 or 4)."""
    shares = colors / 255.0
    light = np.where(shares <= _KNEE, shares / 12.92, ((shares + 0.055) / 1.055) ** 2.4)
    return _with_alpha_of(light, shares)


def to_srgb(light: Float) -> Bytes:
    """Return sRGB bytes for linear light from 0 to 1, of shape (N, 3 or 4); what lies beyond is cut off."""
    light = np.clip(light, 0, 1)
    shares = np.where(light <= _KNEE / 12.92, light * 12.92, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.rint(255 * _with_alpha_of(shares, light)).astype(np.uint8)


def with_alpha(colors: Bytes) -> Bytes:
    """Return colours of shape (N, 4): those of three columns are opaque."""
    return colors if colors.shape[1] == 4 else np.hstack([colors, np.full((len(colors), 1), 255, np.uint8)])


def _with_alpha_of(colors: Float, source: Float) -> Float:
    return np.column_stack([colors[:, :3], source[:, 3:]])
