"""Points off the surface: found where they differ from their neighbours, and none where all of them agree."""

from __future__ import annotations

import numpy as np
import pytest

from gnrecon.fit.consistency import find_outliers
from gnrecon.fit.parameters import OutlierParameters
from gnrecon.geometry.signed_distance import Density

COUNT = 1000


def ball(noise: float, rng: np.random.Generator) -> np.ndarray:
    x = rng.standard_normal((COUNT, 3))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return x * (0.8 + noise * rng.standard_normal((COUNT, 1)))


def field(x: np.ndarray) -> np.ndarray:
    """A field that is wrong by more than the points are apart, but wrong alike among neighbours."""
    return np.linalg.norm(x, axis=1) - 0.8 + 0.1 * np.sin(2 * x[:, 0])


@pytest.mark.parametrize("noise", [0.0, 0.002, 0.01])
def test_points_of_a_scan_are_kept(noise: float) -> None:
    x = ball(noise, np.random.default_rng(0))
    assert not find_outliers(field(x), Density(x)).any()


@pytest.mark.parametrize("noise", [0.0, 0.002, 0.01])
def test_points_off_the_surface_are_found(noise: float) -> None:
    rng = np.random.default_rng(1)
    x = ball(noise, rng)
    off = rng.permutation(COUNT)[: int(2 * OutlierParameters.least_share * COUNT)]
    x[off] *= 1 + rng.choice([-0.3, 0.3], (len(off), 1))
    found = find_outliers(field(x), Density(x))
    np.testing.assert_array_equal(np.flatnonzero(found), np.sort(off))


def test_a_single_one_is_chance() -> None:
    x = ball(0.0, np.random.default_rng(2))
    x[0] *= 1.2
    assert not find_outliers(field(x), Density(x)).any()


def test_many_are_no_outliers() -> None:
    x = ball(0.0, np.random.default_rng(3))
    x[: int(1.5 * OutlierParameters.most_share * COUNT)] *= 1.2
    assert not find_outliers(field(x), Density(x)).any()


def test_few_points_have_no_usual_difference() -> None:
    x = ball(0.0, np.random.default_rng(4))[: OutlierParameters.least_points - 1]
    x[0] *= 1.5
    assert not find_outliers(field(x), Density(x)).any()
