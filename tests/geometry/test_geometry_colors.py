"""Every encoding of colours in files gives the same bytes, and linear light is converted back exactly."""

from __future__ import annotations

import numpy as np
import pytest

from gnrecon.geometry.colors import as_bytes, to_linear, to_srgb

ALL = np.arange(256, dtype=np.uint8)
COLORS = np.column_stack([ALL, ALL[::-1], np.roll(ALL, 77)])


@pytest.mark.parametrize(
    "stored",
    [
        COLORS,
        COLORS.astype(np.int32),
        COLORS.astype(np.float64),
        COLORS / 255.0,
        (COLORS / 255.0).astype(np.float32),
        COLORS.astype(np.uint16) * 257,
        COLORS.astype(np.float64) * 257,
    ],
    ids=["bytes", "integers", "numbers to 255", "shares", "single shares", "16 bits", "numbers to 65535"],
)
def test_every_way_of_storing_gives_the_same_bytes(stored: np.ndarray) -> None:
    assert as_bytes(stored).dtype == np.uint8
    assert np.array_equal(as_bytes(stored), COLORS)


def test_what_is_no_number_is_black_and_what_is_too_bright_full() -> None:
    assert as_bytes(np.array([[np.nan, -3.0, 255.0]])).tolist() == [[0, 0, 255]]
    assert as_bytes(np.empty((0, 3))).shape == (0, 3)


def test_light_and_bytes_turn_into_each_other_exactly() -> None:
    with_alpha = np.column_stack([COLORS, ALL])
    assert np.array_equal(to_srgb(to_linear(with_alpha)), with_alpha)
    assert np.array_equal(to_linear(with_alpha)[:, 3], ALL / 255)
    assert to_srgb(np.array([[-1.0, 0.5, 2.0]])).tolist() == [[0, 188, 255]]


def test_the_curve_is_that_of_the_standard() -> None:
    # Values of IEC 61966-2-1: the line near black, and half the light at 188 of 255.
    light = to_linear(np.array([[10, 128, 255]], dtype=np.uint8))[0]
    assert light == pytest.approx([10 / 255 / 12.92, 0.2158605, 1.0], abs=1e-7)
