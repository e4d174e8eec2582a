"""Parts of the samples of a fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gnrecon.geometry.arrays import Int, Mask
from gnrecon.geometry.point_cloud import Frame, Samples
from gnrecon.runtime.errors import InputError


@pytest.mark.parametrize("rows", [np.array([2, 0]), np.array([True, False, True])])
def test_a_part_of_the_samples_keeps_all_else(rows: Int | Mask) -> None:
    points, normals = np.arange(9.0).reshape(3, 3), np.eye(3)
    held_out = Samples(points, normals, Frame(np.ones(3), 2.0))
    deviations = np.array([0.3, 0.1, 0.2])
    every = Samples(points, normals, Frame(np.ones(3), 2.0), held_out, True, 0.1, True, deviations)
    part = every.select(rows)
    np.testing.assert_array_equal(part.points, points[rows])
    np.testing.assert_array_equal(part.normals, normals[rows])
    assert part.deviations is not None
    np.testing.assert_array_equal(part.deviations, deviations[rows])
    assert (part.frame, part.held_out, part.estimated, part.noise) == (every.frame, held_out, True, 0.1)
    assert len(every) == 3


def test_the_normals_of_more_samples_are_as_sure_as_most() -> None:
    points, normals = np.arange(9.0).reshape(3, 3), np.eye(3)
    samples = Samples(points, normals, Frame(np.ones(3), 2.0), deviations=np.array([0.3, 0.1, 0.2]))
    more = samples.appended(points[:2] + 1.0, normals[:2])
    np.testing.assert_array_equal(more.points[3:], points[:2] + 1.0)
    np.testing.assert_array_equal(more.normals[3:], normals[:2])
    assert more.deviations is not None
    np.testing.assert_array_equal(more.deviations, [0.3, 0.1, 0.2, 0.2, 0.2])
    assert Samples(points, normals, samples.frame).appended(points, normals).deviations is None
    # Of other points, nothing is known.
    assert samples.replaced(points[:1], normals[:1]).deviations is None
    with pytest.raises(InputError, match="1 points cannot go with 3 deviations"):
        replace(samples, points=points[:1])
