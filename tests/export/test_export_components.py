"""Stray components fall by the votes of the points; those that the field shows no gap between vote together."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from analytic_fields import UTM, Field, Function, plate, shells, sphere, union
from scipy.spatial import cKDTree
from trimesh.triangles import closest_point

from gnrecon.export import (
    SignedDistance,
    components,
    drop_stray_components,
    extract,
    project,
    remove_stray,
    require_bordered,
    require_sound,
    verify,
)
from gnrecon.export.components import bridge, supported_components
from gnrecon.export.mesh_field import MeshOptions, mesh_field
from gnrecon.export.mesh_statistics import face_components, submesh
from gnrecon.export.metrics import nearest_on_surface
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.mesh import Mesh
from gnrecon.runtime.errors import UsageError


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
        found = components._nearest_faces(mesh, points, within, most_pairs=most_pairs)
        corners = mesh.vertices[mesh.faces[found]]
        off = np.linalg.norm(closest_point(corners, points) - points, axis=1)
        np.testing.assert_allclose(off, distances, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(components._nearest_components(mesh, labels, points), labels[exact])


def test_few_points_next_to_a_stray_part_need_no_other_library(monkeypatch: pytest.MonkeyPatch) -> None:
    def slow(*_: object) -> None:
        raise AssertionError("open3d is asked for")

    monkeypatch.setattr(components, "nearest_on_surface", slow)
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


def rod(*pinches: float, depth: float = 0.004, radius: float = 0.15, half: float = 0.7) -> Function:
    """A rod along x with round ends; where it is pinched, its radius falls to minus the depth."""

    def distance(x: Float) -> Float:
        along = np.clip(x[:, 0], -half, half)
        off = np.linalg.norm(x - along[:, None] * [1, 0, 0], axis=1)
        near = [np.exp(-(((along - place) / (1.5 * radius)) ** 2)) for place in pinches]
        return np.asarray(off - radius + (radius + depth) * np.sum(near, axis=0))

    return distance


def on_rod(begin: float, end: float, count: int, radius: float = 0.14) -> Float:
    rng = np.random.default_rng(1)
    angle = rng.uniform(0, 2 * np.pi, count)
    return np.column_stack([rng.uniform(begin, end, count), radius * np.cos(angle), radius * np.sin(angle)])


def pinched(*pinches: float, **sizes: float) -> Field:
    return Field(rod(*pinches, **sizes), frame=UTM)


def test_a_tip_that_the_field_shows_no_gap_to_votes_with_the_rest_and_is_joined() -> None:
    field = pinched(0.4)
    apart = project(extract(field, resolution=96), field)
    assert verify(apart).components == 2
    # The tip has 6 of 2,006 points, and would need 10.
    points = UTM.to_world(np.concatenate([on_rod(-0.7, 0.2, 2000), on_rod(0.6, 0.8, 6)]))
    assert verify(remove_stray(apart, points)[0]).components == 1
    kept, actions, gaps = supported_components(apart, points, field)
    assert kept is apart
    assert actions == []
    assert gaps.shape == (1, 2, 3)
    np.testing.assert_allclose(UTM.to_unit(gaps[0]), [[0.4, 0, 0]] * 2, atol=0.06)
    joined, said = bridge(kept, gaps, points)
    facts = require_sound(joined)
    assert (facts.components, facts.genus) == (1, 0)
    assert "Joined a component" in said[0]
    whole = Field(rod(), frame=UTM)
    assert apart.volume < joined.volume < extract(whole, resolution=96).volume
    new = cKDTree(apart.vertices).query(joined.vertices)[0] > 1e-9 * UTM.scale
    assert np.linalg.norm(UTM.to_unit(joined.vertices[new]) - [0.4, 0, 0], axis=1).max() < 0.2
    assert joined.normals is not None
    assert (np.einsum("ij,ij->i", joined.normals, Mesh(joined.vertices, joined.faces).vertex_normals()) > 0).all()


def test_a_chain_of_pieces_is_joined_to_the_largest() -> None:
    field = pinched(-0.1, 0.3)
    apart = project(extract(field, resolution=96), field)
    points = UTM.to_world(np.concatenate([on_rod(-0.8, -0.3, 2000), on_rod(0.05, 0.15, 4), on_rod(0.5, 0.8, 5)]))
    kept, actions, gaps = supported_components(apart, points, field)
    assert (kept, actions, len(gaps)) == (apart, [], 2)
    joined, said = bridge(kept, gaps, points)
    assert require_sound(joined).components == 1
    assert "Joined 2 components" in said[0]


def test_parts_that_are_apart_vote_alone_and_stay_apart() -> None:
    field = Field(union(sphere(0.5, (-0.4, 0, 0)), sphere(0.2, (0.4, 0, 0))), frame=UTM)
    apart = project(extract(field, resolution=48), field)
    body = on_sphere(0.5, 2000, (-0.4, 0, 0))
    for count, components_left in ((6, 1), (60, 2)):
        points = UTM.to_world(np.concatenate([body, on_sphere(0.2, count, (0.4, 0, 0))]))
        kept, _, gaps = supported_components(apart, points, field)
        assert verify(kept).components == components_left
        assert len(gaps) == 0
        assert bridge(kept, gaps, points) == (kept, [])


def test_neither_what_no_points_lie_on_nor_a_cavity_is_joined() -> None:
    field = pinched(0.4)
    apart = project(extract(field, resolution=96), field)
    body = UTM.to_world(on_rod(-0.7, 0.2, 2000))
    kept, actions, gaps = supported_components(apart, body, field)
    assert verify(kept).components == 1
    assert "Dropped 1 of 2 components" in actions[0]
    assert len(gaps) == 0
    # The same rod as a hollow in a ball: its tip is a cavity of its own.
    rod_inside = rod(0.4, half=0.5)
    hollow = Field(lambda x: np.maximum(sphere(1.0)(x), -rod_inside(x)), frame=UTM)
    mesh = project(extract(hollow, resolution=96), hollow)
    points = UTM.to_world(np.concatenate([on_sphere(1.0, 2000), on_rod(-0.5, 0.2, 200), on_rod(0.55, 0.6, 20)]))
    assert len(supported_components(mesh, points, hollow)[2]) == 0


def test_two_specks_that_are_joined_only_to_each_other_still_need_the_votes_of_both() -> None:
    shift, speck = np.array([0, 0.7, 0]), rod(0.0, radius=0.12, half=0.3)
    field = Field(union(sphere(0.5, (-0.4, -0.5, 0)), lambda x: speck(x - shift)), frame=UTM)
    mesh = project(extract(field, resolution=96), field)
    assert verify(mesh).components == 3
    body = on_sphere(0.5, 2000, (-0.4, -0.5, 0))
    for each, left in ((4, 1), (6, 3)):
        specks = [on_rod(begin, begin + 0.1, each, radius=0.11) + shift for begin in (-0.3, 0.2)]
        points = UTM.to_world(np.concatenate([body, *specks]))
        kept, _, gaps = supported_components(mesh, points, field)
        assert verify(kept).components == left
        assert len(gaps) == left // 3


def test_a_component_with_no_more_points_than_a_stray_one_is_not_joined() -> None:
    rod_alone, speck = rod(0.4), sphere(0.1, (-0.5, 0.7, 0))
    field = Field(union(rod_alone, speck), frame=UTM)
    mesh = project(extract(field, resolution=96), field)
    assert verify(mesh).components == 3
    tip, body = on_rod(0.6, 0.8, 6), on_rod(-0.7, 0.2, 2000)
    for on_speck, joined in ((5, 1), (6, 0)):
        outliers = on_sphere(0.1, on_speck, (-0.5, 0.7, 0))
        kept, _, gaps = supported_components(mesh, UTM.to_world(np.concatenate([body, tip, outliers])), field)
        assert len(gaps) == joined
        assert verify(kept).components == 1 + joined


def test_a_run_joins_the_tip_and_says_so() -> None:
    class Precise(Field):
        def single(self) -> SignedDistance:
            return self

    field = Precise(rod(0.4), frame=UTM)
    points = UTM.to_world(np.concatenate([on_rod(-0.7, 0.2, 2000), on_rod(0.6, 0.8, 6)]))
    meshed = mesh_field(field, MeshOptions(resolution=96), data=points)
    assert require_sound(meshed.mesh).components == 1
    assert [action for action in meshed.actions if "shows no gap" in action]
    assert verify(mesh_field(field, MeshOptions(resolution=96), data=None).mesh).components == 2
