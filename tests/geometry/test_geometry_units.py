"""Parsing of lengths and boxes."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gnrecon.geometry.units import METRES, parse_box, parse_length
from gnrecon.runtime.errors import UsageError


@pytest.mark.parametrize(
    ("text", "units", "expected"),
    [
        ("0.5", None, 0.5),
        ("-0.5", "mm", -0.5),
        ("1e-3", None, 1e-3),
        (".5", None, 0.5),
        ("2mm", "mm", 2.0),
        ("2mm", "m", 2e-3),
        (" 2 MM ", "cm", 0.2),
        ("-1in", "mm", -25.4),
        ("1ft", "in", 12.0),
        ("5e2 um", "mm", 0.5),
        ("1km", "m", 1000.0),
    ],
)
def test_lengths(text: str, units: str | None, expected: float) -> None:
    assert parse_length(text, units) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(
    ("text", "units", "sentence"),
    [
        ("2mm", None, "needs the file's own unit"),
        ("2 furlongs", "mm", "unknown unit"),
        ("two", None, "is not a length"),
        ("", None, "is not a length"),
        ("nan", None, "is not a length"),
        ("inf", None, "is not a length"),
        ("1e999", None, "is not a length"),
        ("2,5", None, "is not a length"),
        ("1", "inch", "must be one of um, mm"),
    ],
)
def test_what_is_no_length(text: str, units: str | None, sentence: str) -> None:
    with pytest.raises(UsageError, match=sentence) as caught:
        parse_length(text, units)
    assert "\n" not in str(caught.value)


@given(st.one_of(st.just(0.0), st.floats(1e-30, 1e30), st.floats(-1e30, -1e-30)), st.sampled_from(sorted(METRES)))
def test_a_length_in_the_files_own_unit_is_the_number_itself(number: float, unit: str) -> None:
    assert parse_length(repr(number), None) == number
    assert parse_length(f"{number!r}{unit}", unit) == pytest.approx(number, rel=1e-15, abs=0)


def test_boxes() -> None:
    assert parse_box("-1,-2, -3,1e1,2,3.5") == ((-1.0, -2.0, -3.0), (10.0, 2.0, 3.5))
    for text in ("1,2,3", "0,0,0,1,1,one", "0,0,0,1,1,1,1", ""):
        with pytest.raises(UsageError, match="six numbers"):
            parse_box(text)
    for text in ("0,0,0,1,1,0", "1,0,0,0,1,1", "0,0,0,1,1,inf", "nan,0,0,1,1,1"):
        with pytest.raises(UsageError, match="lower corner must come first"):
            parse_box(text)
