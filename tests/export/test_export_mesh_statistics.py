"""Angles and edge lengths, against plain loops over the faces."""

from __future__ import annotations

import numpy as np
import pytest

from gnrecon.export.mesh_statistics import corner_angles, edge_lengths, quality
from gnrecon.geometry.mesh import Mesh

TETRAHEDRON = Mesh(
    np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1.0]]) + 1e6,
    np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]]),
)


def test_a_tetrahedron_is_equilateral() -> None:
    found = quality(TETRAHEDRON)
    assert all(angle == pytest.approx(60) for angle in found.angle_degrees.values())
    assert found.edge_length == pytest.approx({"mean": 8**0.5, "min": 8**0.5, "max": 8**0.5, "std": 0}, abs=1e-9)
    assert len(found.histogram["edges"]) == 37
    assert sum(found.histogram["counts"]) == 12


def test_figures_agree_with_plain_loops() -> None:
    rng = np.random.default_rng(5)
    mesh = Mesh(rng.normal(size=(30, 3)), np.array([rng.choice(30, 3, replace=False) for _ in range(50)]))
    angles, lengths = [], {}
    for face in mesh.faces.tolist():
        for k in range(3):
            a, b, c = (mesh.vertices[face[(k + j) % 3]] for j in range(3))
            cosine = (b - a) @ (c - a) / np.linalg.norm(b - a) / np.linalg.norm(c - a)
            angles.append(np.degrees(np.arccos(cosine)))
            lengths[tuple(sorted((face[k], face[(k + 1) % 3])))] = np.linalg.norm(b - a)
    assert corner_angles(mesh).reshape(-1) == pytest.approx(np.array(angles))
    assert sorted(edge_lengths(mesh)) == pytest.approx(sorted(lengths.values()))
    found = quality(mesh)
    assert found.angle_degrees["p5"] == pytest.approx(np.percentile(angles, 5))
    assert found.edge_length["std"] == pytest.approx(np.std([*lengths.values()]))
    counts = [sum(low <= a < low + 5 for a in angles) for low in range(0, 180, 5)]
    assert found.histogram["counts"] == counts


def test_needles_and_faces_without_area_have_angles() -> None:
    mesh = Mesh(np.array([[0, 0, 0], [1, 0, 0], [0.5, 1e-12, 0], [1, 0, 0]]), np.array([[0, 1, 2], [0, 1, 3]]))
    found = corner_angles(mesh)
    assert np.isfinite(found).all()
    assert found[0] == pytest.approx([0, 0, 180], abs=1e-6)
    assert found[0, 0] == pytest.approx(np.degrees(2e-12), rel=1e-3)
