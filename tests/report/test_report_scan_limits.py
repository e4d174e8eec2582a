"""What a scan cannot tell is said: few points, and parts that the cells do not resolve."""

from __future__ import annotations

import numpy as np
import pytest
from scan_files import torus

from gnrecon.report.scan_limits import coarse_parts_remark, few_points_remark, thin_sheet_remark


def test_few_points_say_how_far_apart_they_are() -> None:
    cube = np.array(np.meshgrid([0, 1], [0, 1], [0, 1])).reshape(3, 8).T * 6.0
    (sentence,) = few_points_remark(cube)
    assert "only 8 points, 6 apart (58 % of the diagonal)" in sentence
    assert few_points_remark(np.random.default_rng(0).normal(size=(100, 3))) == []
    assert few_points_remark(np.zeros((1, 3))) == []


@pytest.mark.parametrize(("distance", "parts"), [(3.0, None), (300.0, "2 parts of the scan are")])
def test_equal_parts_far_apart(distance: float, parts: str | None) -> None:
    points = torus(400, np.random.default_rng(0))[0]
    both = np.concatenate([points, points + distance])
    found = coarse_parts_remark(both, np.ptp(both, axis=0).max() / 128)
    assert len(found) == (parts is not None)
    assert all(sentence.startswith(str(parts)) for sentence in found)


def test_a_small_part_beside_a_large_one() -> None:
    points = torus(400, np.random.default_rng(0))[0]
    both = np.concatenate([100 * points, points + np.array([0.0, 0.0, 150.0])])
    (sentence,) = coarse_parts_remark(both, np.ptp(both, axis=0).max() / 128)
    assert sentence.startswith("A part of the scan is far smaller")
    assert coarse_parts_remark(both, np.ptp(both, axis=0).max() / 128 / 40) == []


def test_scans_of_one_part_are_never_said_to_have_more() -> None:
    rng = np.random.default_rng(0)
    for points in (torus(50, rng)[0], rng.normal(size=(3000, 3)), np.zeros((5, 3)), np.empty((0, 3))):
        assert coarse_parts_remark(points, 10.0) == []


def test_a_sheet_too_thin_for_the_cells_is_said() -> None:
    assert thin_sheet_remark(None, None, 10, 50.0) == thin_sheet_remark(0.5, None, 200, 50.0) == []
    (sentence,) = thin_sheet_remark(0.25, None, 256, 50.0)
    assert "0.25 apart" in sentence
    assert "--resolution 400 resolves it" in sentence
    (sentence,) = thin_sheet_remark(None, 0.2, 256, 50.0)
    assert "the two sides of a thin sheet" in sentence
    assert "--resolution 500" in sentence
