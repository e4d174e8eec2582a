"""Repair returns a sound mesh or raises."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from analytic_fields import UTM, Field, ball_mesh, sines, sphere
from planted_defects import touching_in_a_vertex, touching_in_an_edge, with_a_fin, with_a_flipped_face

from gnrecon.export import (
    extract,
    project,
    repair,
    require_sound,
    verify,
    verify_file,
)
from gnrecon.geometry.mesh import Mesh
from gnrecon.io import write_mesh
from gnrecon.runtime.errors import MeshError


@pytest.fixture(scope="module")
def ball() -> Mesh:
    return ball_mesh()


def test_a_sound_mesh_comes_back_as_it_is(ball: Mesh) -> None:
    result, actions = repair(ball)
    assert result is ball
    assert actions == []


def test_planted_defects_are_mended(ball: Mesh) -> None:
    soup = Mesh(ball.corners.reshape(-1, 3), np.arange(3 * len(ball.faces)).reshape(-1, 3))
    broken = {
        "hole": Mesh(ball.vertices, ball.faces[6:], ball.normals),
        "flipped face": with_a_flipped_face(ball),
        "inside out": Mesh(ball.vertices, ball.faces[:, ::-1]),
        "repeated faces": Mesh(ball.vertices, np.concatenate([ball.faces, ball.faces[:4]])),
        "fin": with_a_fin(ball),
        "unjoined corners": soup,
    }
    for name, mesh in broken.items():
        result, actions = repair(mesh)
        facts = require_sound(result)
        assert actions, name
        assert facts.volume == pytest.approx(ball.volume, rel=1e-3), name
        assert np.abs(result.vertices - UTM.center).max() < 0.81 * UTM.scale, name


def test_float64_survives_repair(ball: Mesh) -> None:
    """Sewing passes through manifold3d; in float32 a northing of 4.5 million would move by a quarter of a metre."""
    soup = Mesh(ball.corners.reshape(-1, 3), np.arange(3 * len(ball.faces)).reshape(-1, 3))
    result, _ = repair(soup)
    ours, theirs = np.unique(result.vertices, axis=0), np.unique(ball.vertices, axis=0)
    assert np.allclose(ours, theirs, rtol=0, atol=1e-8)


def test_touching_parts_are_set_apart(ball: Mesh) -> None:
    for mesh in (touching_in_a_vertex(ball), touching_in_an_edge()):
        result, actions = repair(mesh)
        assert require_sound(result).components == 2
        assert actions
        assert len(np.unique(result.vertices, axis=0)) == len(result.vertices)
        assert result.volume == pytest.approx(mesh.volume, rel=1e-3)


def test_vertices_that_rounding_brought_together_are_joined(ball: Mesh, tmp_path: Path) -> None:
    """STL knows vertices by their place, and would join them without the faces between."""
    length = np.linalg.norm(ball.corners - np.roll(ball.corners, 1, axis=1), axis=2)
    step = float(np.quantile(length, 0.05))
    rounded = ball.with_vertices(np.round(ball.vertices / step) * step)
    assert verify(rounded).closed
    assert len(np.unique(rounded.vertices, axis=0)) < len(rounded.vertices)
    mended, _ = repair(rounded)
    assert len(np.unique(mended.vertices, axis=0)) == len(mended.vertices)
    assert verify(mended).genus == 0
    assert mended.volume == pytest.approx(ball.volume, rel=0.02)
    write_mesh(mended, tmp_path / "ball.stl")
    assert verify_file(tmp_path / "ball.stl").vertices == len(mended.vertices)


def test_normals_stay_outward(ball: Mesh) -> None:
    assert ball.normals is not None
    for mesh in (
        Mesh(ball.vertices, ball.faces[6:], ball.normals),
        Mesh(ball.vertices, ball.faces[:, ::-1], -ball.normals),
    ):
        result, _ = repair(mesh)
        assert result.normals is not None
        assert (np.einsum("ij,ij->i", result.normals, result.vertices - UTM.center) > 0).all()


def test_what_cannot_be_repaired_is_said() -> None:
    fine = extract(Field(sphere()), resolution=64)
    half = fine.faces[fine.corners.mean(axis=1)[:, 0] > 0]
    with pytest.raises(MeshError, match="Repair was not enough: the mesh is open"):
        repair(Mesh(fine.vertices, half))
    with pytest.raises(MeshError, match="empty"):
        repair(Mesh(np.empty((0, 3)), np.empty((0, 3), dtype=np.int64)))
    with pytest.raises(MeshError, match="no face"):
        repair(Mesh(np.eye(3), np.array([[0, 0, 1]])))


@pytest.mark.parametrize("seed", range(6))
def test_random_fields_and_random_damage_never_pass_unsound(seed: int) -> None:
    rng = np.random.default_rng(seed)
    field = Field(sines(seed, frequency=8.0))
    mesh, actions = repair(project(extract(field, resolution=32), field))
    require_sound(mesh)
    assert actions == []
    faces = mesh.faces[rng.random(len(mesh.faces)) > 0.003]
    faces[rng.integers(len(faces), size=5)] = rng.integers(len(mesh.vertices), size=(5, 3))
    try:
        mended, _ = repair(Mesh(mesh.vertices, faces))
    except MeshError:
        return
    require_sound(mended)
