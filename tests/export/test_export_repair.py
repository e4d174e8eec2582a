"""Repair returns a sound mesh or raises; stray components fall by the votes of the points."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from analytic_fields import UTM, Field, ball_mesh, plate, shells, sines, sphere, union
from planted_defects import touching_in_a_vertex, touching_in_an_edge, with_a_fin, with_a_flipped_face
from scipy.spatial import cKDTree
from trimesh.triangles import closest_point

from gnrecon.export import (
    drop_stray_components,
    extract,
    project,
    remove_stray,
    repair,
    require_bordered,
    require_sound,
    verify,
    verify_file,
)
from gnrecon.export.mesh_statistics import face_components, submesh
from gnrecon.export.metrics import nearest_on_surface
from gnrecon.geometry.mesh import Mesh
from gnrecon.io import write_mesh
from gnrecon.runtime.errors import MeshError, UsageError

repair_module = sys.modules["gnrecon.export.repair"]
"""The package has a function of that name."""


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


def on_sphere(radius: float, count: int, center: tuple[float, float, float] = (0, 0, 0)) -> np.ndarray:
    directions = np.random.default_rng(0).normal(size=(count, 3))
    return np.array(center) + radius * directions / np.linalg.norm(directions, axis=1, keepdims=True)


def test_a_ghost_without_points_is_dropped_and_the_part_with_points_stays() -> None:
    both = extract(Field(union(sphere(0.5, (-0.4, 0, 0)), sphere(0.2, (0.6, 0, 0)))), resolution=48)
    points = on_sphere(0.5, 1000, (-0.4, 0, 0))
    mesh, actions = remove_stray(both, points)
    assert require_sound(mesh).components == 1
    assert mesh.vertices[:, 0].max() < 0.15
    assert "Dropped 1 of 2 components" in actions[0]
    assert "fewer than 5 of the 1000 points" in actions[0]
    few = np.concatenate([points, on_sphere(0.2, 6, (0.6, 0, 0))])
    kept, actions = remove_stray(both, few)
    assert kept is both
    assert actions == []


def test_the_best_supported_part_stays_however_few_the_points() -> None:
    both = extract(Field(union(sphere(0.5, (-0.4, 0, 0)), sphere(0.2, (0.6, 0, 0)))), resolution=32)
    mesh, _ = remove_stray(both, np.array([[0.8, 0, 0]]))
    assert verify(mesh).components == 1
    assert mesh.vertices[:, 0].min() > 0.3


def test_each_point_is_nearest_to_the_component_of_its_nearest_face(rng: np.random.Generator) -> None:
    # Two balls that nearly touch, and long faces next to short ones.
    both = extract(Field(union(sphere(0.5, (-0.4, 0, 0)), sphere(0.2, (0.38, 0, 0)))), resolution=48)
    vertices = np.concatenate([both.vertices, [[1.1, -3, -3], [1.1, 3, -3], [1.1, 0, 3]]])
    mesh = Mesh(vertices, np.concatenate([both.faces, [[len(vertices) - 3, len(vertices) - 2, len(vertices) - 1]]]))
    points = np.concatenate([rng.uniform(-1, 1, (300, 3)), [0.14, 0, 0] + 0.03 * rng.standard_normal((300, 3))])
    within = cKDTree(mesh.vertices).query(points)[0]
    distances, exact = nearest_on_surface(mesh, points)
    labels = face_components(mesh)
    assert len(np.unique(labels[exact])) == 3
    for most_pairs in (10**9, 0):
        found = repair_module._nearest_faces(mesh, points, within, most_pairs=most_pairs)
        corners = mesh.vertices[mesh.faces[found]]
        off = np.linalg.norm(closest_point(corners, points) - points, axis=1)
        np.testing.assert_allclose(off, distances, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(repair_module._nearest_components(mesh, labels, points), labels[exact])


def test_few_points_next_to_a_stray_part_need_no_other_library(monkeypatch: pytest.MonkeyPatch) -> None:
    def slow(*_: object) -> None:
        raise AssertionError("open3d is asked for")

    monkeypatch.setattr(repair_module, "nearest_on_surface", slow)
    both = extract(Field(union(sphere(0.5, (-0.4, 0, 0)), sphere(0.1, (0.25, 0, 0)))), resolution=48)
    mesh, actions = remove_stray(both, on_sphere(0.5, 1000, (-0.4, 0, 0)))
    assert verify(mesh).components == 1
    assert "Dropped 1 of 2 components" in actions[0]


def test_nested_shells_stay_oriented() -> None:
    field = Field(shells(), frame=UTM)
    nested = project(extract(field, resolution=48), field)

    def kept(*radii: float) -> tuple[Mesh, list[str]]:
        return remove_stray(nested, UTM.to_world(np.concatenate([on_sphere(r, 500) for r in radii])))

    ball = 4 / 3 * np.pi * UTM.scale**3
    assert kept(0.9, 0.7, 0.3)[0] is nested
    outer, _ = kept(0.9)
    assert outer.volume == pytest.approx(ball * 0.9**3, rel=0.02)
    shell, actions = kept(0.9, 0.7)
    assert shell.volume == pytest.approx(ball * (0.9**3 - 0.7**3), rel=0.02)
    assert len(actions) == 1
    inner, actions = kept(0.7, 0.3)
    assert inner.volume == pytest.approx(ball * (0.7**3 - 0.3**3), rel=0.02)
    assert "Reversed 2 components" in actions[1]
    for mesh in (outer, shell, inner):
        require_sound(mesh)
        assert mesh.normals is not None
        faces = Mesh(mesh.vertices, mesh.faces).vertex_normals()
        assert (np.einsum("ij,ij->i", faces, mesh.normals) > 0).all()


def test_stray_parts_of_a_surface_with_borders_are_dropped() -> None:
    # A ball and a speck; faces beyond a plane are missing from both, as at the end of a box.
    both = extract(Field(union(sphere(0.5, (-0.4, 0, 0)), sphere(0.2, (0.6, 0, 0)))), resolution=32)
    open_ones = submesh(both, (both.corners[:, :, 2] > -0.1).all(axis=1))
    mesh, actions = drop_stray_components(open_ones, on_sphere(0.5, 1000, (-0.4, 0, 0)))
    facts = require_bordered(mesh)
    assert facts.components == 1
    assert facts.boundary_edges > 0
    assert mesh.vertices[:, 0].max() < 0.15
    assert "Dropped 1 of 2 components" in actions[0]
    outward = np.einsum("ij,ij->i", mesh.vertex_normals(), mesh.vertices - (-0.4, 0, 0))
    assert (outward > 0).all(), "what stays keeps its side"
    assert drop_stray_components(mesh, on_sphere(0.5, 10, (-0.4, 0, 0))) == (mesh, [])


@pytest.mark.parametrize("without", [remove_stray, drop_stray_components])
def test_stray_parts_need_points(without: Callable[[Mesh, np.ndarray], object]) -> None:
    with pytest.raises(UsageError, match="no points"):
        without(extract(Field(plate(0.1)), resolution=16), np.empty((0, 3)))
