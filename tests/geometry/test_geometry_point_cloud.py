"""Parts of the samples of a fit."""

from __future__ import annotations

import numpy as np
import pytest

from gnrecon.geometry.arrays import Int, Mask
from gnrecon.geometry.point_cloud import Frame, Samples


@pytest.mark.parametrize("rows", [np.array([2, 0]), np.array([True, False, True])])
def test_a_part_of_the_samples_keeps_all_else(rows: Int | Mask) -> None:
    points, normals = np.arange(9.0).reshape(3, 3), np.eye(3)
    held_out = Samples(points, normals, Frame(np.ones(3), 2.0))
    every = Samples(points, normals, Frame(np.ones(3), 2.0), held_out, True, 0.1)
    part = every.select(rows)
    np.testing.assert_array_equal(part.points, points[rows])
    np.testing.assert_array_equal(part.normals, normals[rows])
    assert (part.frame, part.held_out, part.estimated, part.noise) == (every.frame, held_out, True, 0.1)
    assert len(every) == 3
