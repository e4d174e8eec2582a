"""The estimate follows the runs that it was made from, and is silent about runs that were not measured."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from gnrecon.options import Options
from gnrecon.report.estimate import Estimate, estimate, expected_within_memory, mesh_memory_mb
from gnrecon.runtime.errors import MemoryLimitError

BOX = np.array([[0.0, 0, 0], [1.0, 1, 1]])


def expected(points: int, **options: Any) -> Estimate:
    found = estimate(points, points, BOX, Options(**options))
    assert found is not None
    return found


@pytest.mark.parametrize(
    ("points", "cells", "seconds"),
    [
        (1000, 128, 5.4),
        (5000, 310, 9.6),
        (14_687, 256, 12.5),
        (20_000, 256, 14.2),
        (20_000, 512, 45.4),
        (100_000, 256, 37.8),
    ],
)
def test_measured_runs_are_met_to_within_a_factor(points: int, cells: int, seconds: float) -> None:
    assert 1 / 1.6 < expected(points, resolution=cells).seconds / seconds < 1.6


def test_resolution_and_quality_count() -> None:
    assert expected(8000, resolution=512).seconds > 2.5 * expected(8000).seconds
    assert expected(8000, resolution=512).memory_mb == pytest.approx(2135, rel=0.02)
    assert expected(8000, edge_length=1 / 300).seconds > expected(8000).seconds
    draft, normal, high = (expected(8000, quality=name).seconds for name in ("draft", "normal", "high"))
    assert draft < normal < high
    assert expected(2_000_000).memory_mb > 2000


@pytest.mark.parametrize("options", [{"widths": (2000,)}, {"steps": 0}, {"device": "cuda"}, {"max_error": 0.01}])
def test_runs_that_were_not_measured_have_none(options: dict[str, Any]) -> None:
    assert estimate(5000, 5000, BOX, Options(**options)) is None


def test_a_long_and_thin_box_holds_less_surface() -> None:
    assert mesh_memory_mb(512, BOX) == pytest.approx(2130, rel=0.01)
    assert mesh_memory_mb(512, BOX * [1, 1, 0.25]) == mesh_memory_mb(512, BOX)
    thin = mesh_memory_mb(4096, BOX * [1, 0.01, 0.01]) - mesh_memory_mb(0, BOX)
    assert thin < 0.02 * (mesh_memory_mb(4096, BOX) - mesh_memory_mb(0, BOX))


def test_the_sentence() -> None:
    assert Estimate(43.2, 950).describe() == "It would take about 40 seconds on two idle cores, and 0.9 GB of memory."
    assert "about 12 seconds" in Estimate(12.2, 950).describe()
    assert "about 4 minutes" in Estimate(251, 950).describe()


def test_a_network_whose_last_layer_fills_the_memory_is_refused() -> None:
    with pytest.raises(MemoryLimitError, match="smaller --widths"):
        expected_within_memory(50, 50, BOX, Options(widths=(300_000,), resolution=16))
    assert expected_within_memory(50, 50, BOX, Options(widths=(64, 64), resolution=16)) is None
