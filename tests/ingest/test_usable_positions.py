"""Coordinates of damaged files: what is dropped, and what is refused."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.ingest.clean import clean, usable_positions
from gnrecon.runtime.errors import InputError


def ball(count: int = 200) -> np.ndarray:
    points = np.random.default_rng(0).normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("far", [1e20, 1e38, -1e155, 1.7e308, np.inf, np.nan])
def test_coordinates_out_of_all_proportion_are_dropped_and_counted(far: float) -> None:
    points = ball()
    points[3, 1] = points[70, 0] = far
    kept, counts = clean(PointCloud(points))
    assert counts.non_finite == 2
    assert np.abs(kept.points).max() <= 1


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("scale", [1e150, 1e300, 1e-160, 1e-300])
def test_scans_that_cannot_be_computed_with_are_refused(scale: float) -> None:
    with pytest.raises(InputError, match="scale the scan"):
        clean(PointCloud(ball() * scale))


def test_pulses_without_an_echo_leave_the_scan_usable() -> None:
    points = np.concatenate([np.zeros((400, 3)), ball() + 4e6])
    assert usable_positions(points).all()


def test_the_greatest_double_next_to_a_tiny_scan_raises_no_warning() -> None:
    points = np.vstack([1e-12 * np.random.default_rng(0).standard_normal((20, 3)), [[1.7e308, 0.0, 0.0]]])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert usable_positions(points).tolist() == [True] * 20 + [False]
