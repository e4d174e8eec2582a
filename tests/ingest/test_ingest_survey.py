"""The facts of clouds that are known: their noise, their normals' state, and their borders."""

from __future__ import annotations

import numpy as np
import pytest

from gnrecon.cloud import PointCloud
from gnrecon.ingest.survey import Survey, survey


def sphere(rng: np.random.Generator, noise: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    normals = rng.normal(size=(6000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return normals * (1 + noise * rng.normal(size=(6000, 1))), normals


def facts(points: np.ndarray, normals: np.ndarray | None = None) -> Survey:
    found = survey(PointCloud(points, normals))
    assert found is not None
    return found


@pytest.mark.parametrize("noise", [0.0, 0.002, 0.01])
def test_noise_is_told_apart_from_curvature(noise: float, rng: np.random.Generator) -> None:
    assert facts(sphere(rng, noise)[0]).noise == pytest.approx(noise, rel=0.2, abs=2e-4)


def test_the_state_of_normals(rng: np.random.Generator) -> None:
    points, normals = sphere(rng)
    signs = rng.choice([-1.0, 1.0], (len(normals), 1))
    states = {"good": normals, "inward": -normals, "inconsistent": signs * normals, "zero": 0 * normals}
    states["unnormalised"] = 3 * normals
    for state, given in states.items():
        assert facts(points, given).normals == state
    assert facts(points).normals == "missing"


def test_borders_counts_and_extent(rng: np.random.Generator) -> None:
    points, _ = sphere(rng)
    assert not facts(points).open
    half = facts(points[points[:, 2] > 0])
    assert half.open
    assert half.border_share < 0.1
    mixed = np.vstack([points, points[:7], np.full((3, 3), np.nan), [[9.0, 9, 9]]])
    found = facts(mixed)
    assert (found.points, found.duplicates, found.non_finite, found.outliers) == (6011, 7, 3, 1)
    assert found.upper == [9, 9, 9]
    assert survey(PointCloud(points[:20])) is None
