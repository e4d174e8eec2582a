"""Angles about an axis."""

from __future__ import annotations

import numpy as np
import pytest

from gnrecon.geometry.statistics import widest_gap


def test_the_widest_gap_about_an_axis() -> None:
    turns = np.radians([10.0, 80.0, 200.0, 300.0])
    around = np.stack([np.cos(turns), np.sin(turns), [0.5, -2.0, 0.0, 1.0]], axis=1)
    for turn in (np.eye(3), np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])):
        axis = np.array([0.0, 0.0, 1.0]) @ turn
        assert np.degrees(widest_gap(around @ turn, axis)) == pytest.approx(120.0)
        assert widest_gap(around[:1] @ turn, axis) == pytest.approx(2 * np.pi)
        assert widest_gap(around[:0], axis) == 2 * np.pi
