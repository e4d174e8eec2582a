"""The search of wrong signs against the signs of a sphere."""

from __future__ import annotations

import numpy as np
import pytest

from gnrecon.fit.free_space import Volume
from gnrecon.fit.initialisation import WrongSignSearch
from gnrecon.fit.parameters import FreeSpaceParameters
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.signed_distance import CoarseDistance

GHOST, CAVITY, RADIUS = np.array([1.3, 0.2, 0.1]), np.array([0.1, -0.5, 0.0]), 0.2


@pytest.fixture
def coarse(rng: np.random.Generator) -> CoarseDistance:
    normals = rng.standard_normal((2000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return CoarseDistance(normals, normals, rng)


def haunted(x: Float) -> Float:
    """A sphere's distance, with the wrong sign in a ball outside and in one inside."""
    signed = np.linalg.norm(x, axis=1) - 1.0
    for center in (GHOST, CAVITY):
        signed = np.where(np.linalg.norm(x - center, axis=1) < RADIUS, -signed, signed)
    return signed


def test_all_wrong_signs_are_found_and_few_are_asked_for(
    coarse: CoarseDistance, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []
    sign = coarse.sign
    monkeypatch.setattr(coarse, "sign", lambda x: (asked.append(len(x)), sign(x))[1])
    known, signed = coarse.sample(rng.uniform(-1.6, 1.6, (3000, 3)))
    asked.clear()
    x = rng.uniform(-1.6, 1.6, (20_000, 3))
    wrong_signs, distances = WrongSignSearch(coarse, known, np.sign(signed)).wrong_signs(x, haunted)
    clear, true, *_ = coarse.at(x)
    wrong = haunted(x[clear]) * true < 0
    assert 20 < len(wrong_signs) == wrong.sum()
    np.testing.assert_allclose(wrong_signs, x[clear][wrong])
    np.testing.assert_allclose(distances, true[wrong])
    assert len(wrong_signs) <= asked[0] < 0.15 * len(x)


@pytest.mark.seed(2068095738)
def test_signs_that_were_found_are_remembered(coarse: CoarseDistance, rng: np.random.Generator) -> None:
    none = np.zeros(0)
    search = WrongSignSearch(coarse, np.zeros((0, 3)), none)
    x = rng.uniform(-1.6, 1.6, (2000, 3))
    wrong_signs, _ = search.wrong_signs(x, haunted)
    assert len(wrong_signs) > 5
    # Nothing was known, so that everything was asked for.
    assert len(search.points) == len(search.signs) == coarse.size(x)[0].sum()
    np.testing.assert_array_equal(search.signs, np.sign(np.linalg.norm(search.points, axis=1) - 1))
    before = len(search.points)
    assert len(search.wrong_signs(x, haunted)[0]) == len(wrong_signs)
    assert len(search.points) == before + len(wrong_signs)


def test_free_space_asks_for_about_the_distance_and_for_its_sign() -> None:
    own = np.array([-0.1, 0.01, 0.2, 0.25, 0.9, 0.2, -0.02, -0.2, -0.9])
    signed = np.repeat([0.2, -0.2], [5, 4])
    certain = np.arange(9) != 1
    volume = Volume.around(np.zeros((9, 3)), own, signed, np.where(certain, 0.0, 0.3), np.abs(signed))
    near, far = 0.2 * FreeSpaceParameters.least_field_share, 0.2 * FreeSpaceParameters.most_field_share
    asked = [near, 0.4 * near, 0.2, 0.25, far, -near, -near, -0.2, -far]
    np.testing.assert_allclose(own + volume.wanted, asked, atol=1e-15)
    share = FreeSpaceParameters.sign_bound_share
    np.testing.assert_allclose((volume.lower + own)[:5], np.where(certain, share * 0.2, -np.inf)[:5])
    np.testing.assert_allclose((volume.upper + own)[5:], -share * 0.2)
    assert np.isposinf(volume.upper[:5]).all()
    assert np.isneginf(volume.lower[5:]).all()


def test_free_space_of_a_doubtful_sign_is_left_to_the_field() -> None:
    own, signed = np.array([-0.1, -0.9, 0.1, 0.01, 0.9]), np.array([0.2, 0.2, -0.2, 0.2, 0.2])
    volume = Volume.around(np.zeros((5, 3)), own, signed, np.full(5, 0.3), np.abs(signed))
    near, far = 0.4 * 0.2 * FreeSpaceParameters.least_field_share, 0.2 * FreeSpaceParameters.most_field_share
    np.testing.assert_allclose(own + volume.wanted, [-0.1, -0.9, 0.1, near, far], atol=1e-15)
    assert np.isneginf(volume.lower).all()
    assert np.isposinf(volume.upper).all()


def test_above_a_hole_the_distance_of_its_rim_is_no_distance_of_the_film() -> None:
    """A disk-shaped hole of radius one in the plane z = 0, seen from its axis: w = (1 - z / sqrt(1 + z^2)) / 2."""
    height = np.array([-3.0, -0.9, -0.2, -1e-3, 1e-3, 0.2, 0.9, 3.0])
    rim = np.sqrt(1 + height**2)
    winding = (1 - height / rim) / 2
    # The field is the height over the film, and right everywhere.
    volume = Volume.around(np.zeros((8, 3)), height, np.sign(height) * rim, winding, rim)
    np.testing.assert_array_equal(volume.wanted, 0.0)
    assert (volume.lower <= 0).all()
    assert (volume.upper >= 0).all()
    assert np.isfinite(volume.lower[6:]).all()
    assert np.isfinite(volume.upper[:2]).all()
