"""The search of wrong signs against the signs of a sphere."""

from __future__ import annotations

import numpy as np
import pytest

from gnrecon.cloud import Float
from gnrecon.fit.choose import ENOUGH, Volume
from gnrecon.fit.ghosts import GhostSearch
from gnrecon.sampling import CoarseDistance

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
    ghosts, distances = GhostSearch(coarse, known, np.sign(signed)).ghosts(x, haunted)
    clear, true, _ = coarse.at(x)
    wrong = haunted(x[clear]) * true < 0
    assert 20 < len(ghosts) == wrong.sum()
    np.testing.assert_allclose(ghosts, x[clear][wrong])
    np.testing.assert_allclose(distances, true[wrong])
    assert len(ghosts) <= asked[0] < 0.15 * len(x)


def test_signs_that_were_found_are_remembered(coarse: CoarseDistance, rng: np.random.Generator) -> None:
    none = np.zeros(0)
    search = GhostSearch(coarse, np.zeros((0, 3)), none)
    x = rng.uniform(-1.6, 1.6, (2000, 3))
    ghosts, _ = search.ghosts(x, haunted)
    assert len(ghosts) > 5
    # Nothing was known, so that everything was asked for.
    assert len(search.points) == len(search.signs) == coarse.size(x)[0].sum()
    np.testing.assert_array_equal(search.signs, np.sign(np.linalg.norm(search.points, axis=1) - 1))
    before = len(search.points)
    assert len(search.ghosts(x, haunted)[0]) == len(ghosts)
    assert len(search.points) == before + len(ghosts)


def test_bounds_ask_for_the_sign_and_a_share_of_the_size() -> None:
    own, signed = np.array([-0.1, 0.01, 0.3, 0.2, -0.02, -0.9]), np.array([0.2, 0.2, 0.2, -0.2, -0.2, -0.2])
    volume = Volume.apart(np.zeros((6, 3)), own, signed, np.abs(signed))
    lower, upper = volume.lower + own, volume.upper + own
    np.testing.assert_allclose(lower[:3], ENOUGH * 0.2)
    np.testing.assert_allclose(upper[3:], -ENOUGH * 0.2)
    assert np.isposinf(upper[:3]).all()
    assert np.isneginf(lower[3:]).all()
