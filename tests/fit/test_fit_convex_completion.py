"""Few points in convex position are completed smoothly; others are left as they are."""

from __future__ import annotations

import numpy as np
import pytest
from scan_files import torus

from gnrecon.fit.shape_priors.convex_completion import completed_convex
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.point_cloud import Frame, Samples
from gnrecon.pipeline import Progress, reconstruct

UNIT = Frame(np.zeros(3), 1.0)


def on_sphere(count: int, seed: int = 0) -> Float:
    points = np.random.default_rng(seed).normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


@pytest.mark.parametrize("estimated", [False, True])
def test_points_of_a_sphere_are_completed_nearly_to_it(estimated: bool) -> None:
    points = on_sphere(40)
    wrong = -points if estimated else points  # estimated normals are not believed
    found = completed_convex(Samples(points, wrong, UNIT, estimated=estimated))
    assert found is not None
    assert found.estimated == estimated
    assert (found.points[:40] == points).all()
    added = found.points[40:]
    outward = added / np.linalg.norm(added, axis=1, keepdims=True)
    assert 100 < len(added) < 2000
    radii = np.linalg.norm(added, axis=1)
    assert 0.7 < radii.min() < radii.max() < 1.1
    assert np.median(radii) > 0.95
    assert np.median((found.normals[40:] * outward).sum(axis=1)) > 0.95
    assert ((found.normals[40:] * outward).sum(axis=1) > 0.5).all()
    assert ((found.normals[:40] * points).sum(axis=1) > 0.7).all()
    assert np.linalg.norm(found.normals, axis=1) == pytest.approx(1.0)


def test_flat_faces_stay_flat() -> None:
    rng = np.random.default_rng(1)
    points = rng.uniform(-0.5, 0.5, (90, 3))
    axis, side = rng.integers(0, 3, 90), rng.choice([-0.5, 0.5], 90)
    normals = np.zeros((90, 3))
    points[np.arange(90), axis], normals[np.arange(90), axis] = side, np.sign(side)
    found = completed_convex(Samples(points, normals, UNIT))
    assert found is not None
    within = np.abs(found.points).max(axis=1)
    assert np.median(within) == pytest.approx(0.5, abs=1e-6)
    assert within.max() < 0.6


def test_other_scans_are_left_alone() -> None:
    rng = np.random.default_rng(2)
    points, normals = torus(60, rng)
    assert completed_convex(Samples(points, normals, UNIT)) is None
    assert completed_convex(Samples(on_sphere(101), on_sphere(101), UNIT)) is None
    noisy = on_sphere(60) * rng.normal(1.0, 0.1, (60, 1))
    assert completed_convex(Samples(noisy, on_sphere(60), UNIT)) is None
    flat = np.column_stack([rng.normal(size=(20, 2)), np.zeros(20)])
    assert completed_convex(Samples(flat, np.tile([0.0, 0.0, 1.0], (20, 1)), UNIT)) is None


class Remarks(Progress):
    """Keeps the sentences of a run."""

    def __init__(self) -> None:
        self.sentences: list[str] = []

    def remark(self, sentence: str) -> None:
        self.sentences.append(sentence)


def test_twenty_points_of_a_sphere_give_the_simplest_surface() -> None:
    told = Remarks()
    result = reconstruct(on_sphere(20), quality="draft", resolution=24, progress=told)
    assert (result.report["mesh"]["genus"], result.report["mesh"]["components"]) == (0, 1)
    assert np.abs(np.linalg.norm(result.mesh.vertices, axis=1) - 1).max() < 0.5
    assert any("only 20 points" in sentence for sentence in told.sentences)
    assert any("lie on a convex surface" in sentence for sentence in told.sentences)
