"""What is unusual about a mesh is counted, each thing by itself."""

from __future__ import annotations

import numpy as np
import pytest
from analytic_fields import UTM, Field, sphere
from planted_defects import touching_in_a_vertex, with_a_fin

from gnrecon.export import examine, extract
from gnrecon.geometry.mesh import Mesh


@pytest.fixture(scope="module")
def ball() -> Mesh:
    return extract(Field(sphere()), resolution=16)


def together(*meshes: Mesh) -> Mesh:
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = [mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)]
    return Mesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces))


def test_nothing_is_unusual_about_a_ball(ball: Mesh) -> None:
    found = examine(ball)
    assert found.sound
    assert found.failures == ()
    counts = found.as_dict()
    for name in ("repeated_faces", "flat_faces", "self_intersecting_faces", "unused_vertices", "coincident_vertices"):
        assert counts[name] == 0, name
    assert all(len(line) <= 130 for line in found.describe())


@pytest.mark.parametrize("offset", [(0.0, 0.0, 0.0), tuple(UTM.center)], ids=["at the origin", "UTM"])
def test_faces_that_pass_through_each_other(ball: Mesh, offset: tuple[float, ...]) -> None:
    moved = ball.with_vertices(ball.vertices + np.array([0.7, 0.02, 0.03]))
    both = together(ball, moved)
    found = examine(both.with_vertices(both.vertices + offset))
    # Every face with corners on both sides of the other sphere passes through it.
    first = np.linalg.norm(ball.corners - [0.7, 0.02, 0.03], axis=2) < 0.8
    second = np.linalg.norm(moved.corners, axis=2) < 0.8
    crossing = sum(int((side.any(axis=1) & ~side.all(axis=1)).sum()) for side in (first, second))
    assert found.self_intersecting_faces == pytest.approx(crossing, rel=0.2)
    assert found.sound, "self-intersection alone does not open a surface"
    apart = together(ball, ball.with_vertices(ball.vertices + np.array([1.7, 0.0, 0.0])))
    assert examine(apart).self_intersecting_faces == 0


def test_each_oddity_is_counted(ball: Mesh) -> None:
    a, b, c = ball.faces[0]
    loose = Mesh(np.vstack([ball.vertices, ball.vertices[:2], [[9, 9, 9]]]), ball.faces)
    found = examine(loose)
    assert (found.unused_vertices, found.coincident_vertices) == (3, 2)
    assert found.sound
    repeated = examine(Mesh(ball.vertices, np.vstack([ball.faces, [[b, c, a], [c, b, a]]])))
    assert repeated.repeated_faces == 2
    assert not repeated.sound
    collapsed = examine(Mesh(ball.vertices, np.vstack([ball.faces, [[a, a, b]]])))
    assert (collapsed.facts.degenerate_faces, collapsed.flat_faces) == (1, 0)
    flat = ball.vertices.copy()
    flat[a] = (flat[b] + flat[c]) / 2
    assert examine(ball.with_vertices(flat)).flat_faces == 1


def test_flat_is_what_rounding_cannot_tell_from_flat(ball: Mesh) -> None:
    far = ball.vertices + np.array([5e5, 4.5e6, 100.0])
    a, b, c = ball.faces[0]
    far[a] = (far[b] + far[c]) / 2
    assert examine(ball.with_vertices(far)).flat_faces == 1
    assert examine(ball.with_vertices(1e-9 * ball.vertices)).flat_faces == 0


def test_all_failures_are_listed(ball: Mesh) -> None:
    worst = together(with_a_fin(ball), touching_in_a_vertex(ball), Mesh(ball.vertices, ball.faces[:, ::-1]))
    said = "; ".join(examine(worst).failures)
    # The ends of the fin's edge, and the vertex that two spheres share.
    for word in ("is open: 2 edges", "1 edges shared by more than two", "3 vertices where several fans"):
        assert word in said


def test_no_vertex_and_no_face_is_a_finding_and_no_crash() -> None:
    nothing = examine(Mesh(np.empty((0, 3)), np.empty((0, 3), dtype=np.int64)))
    assert nothing.failures[0] == "is empty"
    assert nothing.self_intersecting_faces == 0
    infinite = examine(Mesh(np.array([[0, 0, 0], [1, 0, 0], [0, np.inf, 0]]), np.array([[0, 1, 2]])))
    assert infinite.broken_vertices == 1
    assert infinite.self_intersecting_faces is None
    assert not infinite.sound
