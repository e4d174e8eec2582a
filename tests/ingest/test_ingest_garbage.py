"""Clouds of numbers of any size, as damaged files hold: each is prepared or refused, and no number overflows."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.ingest import prepare, survey
from gnrecon.ingest.clean import distinct_positions
from gnrecon.options import Options
from gnrecon.runtime.errors import InputError


def garbage(rng: np.random.Generator) -> PointCloud:
    """Points whose sizes differ by up to 90 powers of ten, some with good ones among them, normals and origins."""
    count = int(rng.integers(10, 150))
    low, high = np.sort(rng.uniform(-45, 45, 2)) if rng.integers(0, 2) else (0.0, rng.uniform(0, 39))
    points = rng.normal(size=(count, 3)) * 10.0 ** rng.uniform(low, high, (count, rng.choice([1, 3])))
    if rng.integers(0, 3) == 0:
        good = rng.random(count) < rng.uniform(0.3, 0.95)
        points[good] /= np.linalg.norm(points[good], axis=1, keepdims=True)
    normals = rng.normal(size=(count, 3)) * 10.0 ** rng.uniform(-300, 300, (count, 1))
    origins = rng.normal(size=(count, 3)) * 10.0 ** rng.uniform(-300, 300)
    return PointCloud(points, normals if rng.integers(0, 2) else None, {}, origins if rng.integers(0, 4) == 0 else None)


@pytest.mark.parametrize("first", range(0, 120, 30))
def test_each_is_prepared_or_refused(first: int) -> None:
    prepared = 0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for number in range(first, first + 30):
            cloud = garbage(np.random.default_rng([39, number]))
            try:
                samples = prepare(cloud, **Options().ingest())[0]
                survey(cloud)
            except InputError:
                continue
            assert np.isfinite(samples.points).all()
            assert np.linalg.norm(samples.normals, axis=1) == pytest.approx(1)
            prepared += 1
    assert 0 < prepared < 30


def test_what_coincides_relative_to_the_mean_is_one_position() -> None:
    points = np.array([[1e25, 0, 0], [1e-5, 0, 0], [2e-5, 0, 0], [1.0, 0, 0]])
    assert len(distinct_positions(points)) == 2
    assert len(distinct_positions(points[1:])) == 3
