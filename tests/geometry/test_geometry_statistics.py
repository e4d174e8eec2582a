"""Histograms, and angles about an axis."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gnrecon.geometry.statistics import Histogram, widest_gap


@given(st.lists(st.floats(-10, 10), min_size=1), st.floats(-9, 0), st.floats(1, 9), st.integers(1, 20))
def test_every_value_is_counted_once(values: list[float], low: float, high: float, bins: int) -> None:
    histogram = Histogram.of(np.array(values), low, high, bins)
    assert histogram.total == len(values)
    assert histogram.below == sum(value < low for value in values)
    assert histogram.above == sum(value > high for value in values)
    assert len(histogram.counts) == bins == len(histogram.edges) - 1


def test_weights_and_numbers_that_are_none() -> None:
    values, weights = np.array([0.1, 0.9, 1.0, np.nan, 2.0, -1.0]), np.array([1.0, 2, 4, 8, 16, 32])
    histogram = Histogram.of(values, 0.0, 1.0, 2, weights)
    assert histogram.counts == (1.0, 6.0)
    assert (histogram.below, histogram.above) == (32.0, 16.0)
    assert list(histogram.edges) == [0.0, 0.5, 1.0]
    assert Histogram(**json.loads(json.dumps(histogram.as_dict()))).total == pytest.approx(55.0)


def test_the_widest_gap_about_an_axis() -> None:
    turns = np.radians([10.0, 80.0, 200.0, 300.0])
    around = np.stack([np.cos(turns), np.sin(turns), [0.5, -2.0, 0.0, 1.0]], axis=1)
    for turn in (np.eye(3), np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])):
        axis = np.array([0.0, 0.0, 1.0]) @ turn
        assert np.degrees(widest_gap(around @ turn, axis)) == pytest.approx(120.0)
        assert widest_gap(around[:1] @ turn, axis) == pytest.approx(2 * np.pi)
        assert widest_gap(around[:0], axis) == 2 * np.pi
