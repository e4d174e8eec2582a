"""Remeshing gives nearly equilateral faces on the field, keeps edges, and leaves the surface what it was."""

from __future__ import annotations

import numpy as np
import pytest
from analytic_fields import UTM, Field, Function, sines, sphere, torus
from sharp_fields import between, box, cylinder, extracted, lens, to_box_edges, to_cylinder_edges, to_lens_edge

from gnrecon.export import project, quality, remesh, require_sound, sharpen, verify
from gnrecon.export.remeshing.edge_table import VertexKind
from gnrecon.export.remeshing.remesh import with_creases
from gnrecon.geometry.mesh import Mesh
from gnrecon.runtime.errors import UsageError


def off(mesh: Mesh, field: Field) -> np.ndarray:
    return np.abs(field.sdf(mesh.vertices)) / np.linalg.norm(field.gradient(mesh.vertices), axis=1)


@pytest.mark.parametrize(("function", "genus"), [(sphere(), 0), (torus(), 1)])
@pytest.mark.parametrize("length", [0.06, 0.2])
def test_faces_are_nearly_equilateral(function: Function, genus: int, length: float) -> None:
    field = Field(function, frame=UTM)
    mesh = remesh(extracted(field), field, UTM.scale * length)
    found = quality(mesh)
    assert require_sound(mesh).genus == genus
    assert found.edge_length["mean"] == pytest.approx(UTM.scale * length, rel=0.05)
    assert found.edge_length["max"] < 1.5 * UTM.scale * length
    assert found.edge_length["min"] > 0.5 * UTM.scale * length
    assert found.angle_degrees["min"] > 25
    assert found.angle_degrees["p1"] > 40
    assert off(mesh, field).max() < 1e-8 * UTM.scale
    assert mesh.normals is not None
    unit = field.gradient(mesh.vertices)
    assert np.allclose(mesh.normals, unit / np.linalg.norm(unit, axis=1, keepdims=True), atol=1e-5)


@pytest.mark.parametrize(
    ("function", "distance"), [(box, to_box_edges), (cylinder, to_cylinder_edges), (lens, to_lens_edge)]
)
def test_edges_stay_sharp(function, distance) -> None:  # type: ignore[no-untyped-def]
    field = Field(function())
    plain = extracted(field)
    length = 0.08
    mesh = remesh(project(sharpen(plain, field), field), field, length)
    found = quality(mesh)
    assert require_sound(mesh).genus == 0
    assert found.angle_degrees["p1"] > 30
    to_edge = distance(mesh.vertices)
    on_edge = to_edge < 1e-6
    # No vertex floats beside the edge, and the edge's vertices make its lines.
    assert np.count_nonzero(~on_edge & (to_edge < 0.1 * length)) <= 0.02 * np.count_nonzero(on_edge)
    surface = with_creases(mesh, field, 30.0)
    crease = surface.vertices[surface.creases]
    assert distance(crease.reshape(-1, 3)).max() < 1e-6
    assert np.quantile(distance(crease.mean(axis=1)), 0.99) < 0.15 * length**2 / 0.6
    near_plain, near = (np.abs(field.sdf(p[distance(p) < 0.06])) for p in (between(plain), between(mesh)))
    assert near.mean() < near_plain.mean()
    assert np.quantile(near, 0.999) < np.quantile(near_plain, 0.999)


def test_a_box_keeps_its_corners() -> None:
    field = Field(box())
    mesh = remesh(project(sharpen(extracted(field), field), field), field, 0.1)
    kinds = with_creases(mesh, field, 30.0).kinds()
    assert np.count_nonzero(kinds == VertexKind.CORNER) == 8
    assert np.count_nonzero(kinds == VertexKind.CREASE) > 80
    assert mesh.volume == pytest.approx(8 * 0.7 * 0.6 * 0.35, rel=1e-6)


def test_adapted_lengths_follow_the_curvature() -> None:
    """A thin torus around a ball that bends a fifth as much: short edges on the one, the longest on the other."""
    ball, ring = sphere(0.5), torus(0.8, 0.1)
    field = Field(lambda x: np.minimum(ball(x), ring(x)))
    plain = extracted(field, 40)
    mesh = remesh(plain, field, 0.1, adaptive=True)
    require_sound(mesh)
    lengths = np.linalg.norm(mesh.corners - np.roll(mesh.corners, 1, axis=1), axis=2).mean(axis=1)
    on_ring = np.hypot(*mesh.corners.mean(axis=1)[:, :2].T) > 0.6
    assert lengths[on_ring].mean() == pytest.approx(np.radians(15) * 0.1, rel=0.25)
    assert lengths[~on_ring].mean() == pytest.approx(0.1, rel=0.1)
    assert quality(mesh).angle_degrees["p1"] > 30
    even = remesh(plain, field, float(np.sqrt(mesh.area / (np.sqrt(3) / 4 * len(mesh.faces)))))
    assert len(even.faces) > 0.95 * len(mesh.faces)
    assert bend(mesh, field) < 0.8 * bend(even, field)


def bend(mesh: Mesh, field: Field) -> float:
    """How much the normal turns along a side of a face, in radians, at the 99th percentile."""
    normals = field.gradient(mesh.vertices)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    sides = normals[mesh.faces] - normals[np.roll(mesh.faces, 1, axis=1)]
    return float(np.quantile(np.linalg.norm(sides, axis=2), 0.99))


def test_flat_faces_of_a_box_are_not_refined() -> None:
    field = Field(box())
    sharp = project(sharpen(extracted(field), field), field)
    even, adapted = (remesh(sharp, field, 0.15, adaptive=adaptive) for adaptive in (False, True))
    assert len(adapted.faces) < 1.1 * len(even.faces)


def test_the_same_mesh_gives_the_same_bytes() -> None:
    field = Field(lens())
    plain = extracted(field)
    one, other = (remesh(plain, field, 0.1) for _ in range(2))
    assert one.vertices.tobytes() == other.vertices.tobytes()
    assert one.faces.tobytes() == other.faces.tobytes()


@pytest.mark.parametrize("seed", range(2))
def test_wild_fields_keep_their_topology(seed: int) -> None:
    field = Field(sines(seed, frequency=4.0))
    plain = extracted(field, 16)
    before = verify(plain)
    for length in (0.15, 0.4):
        after = verify(remesh(plain, field, length))
        assert after.closed
        assert after.manifold
        assert after.oriented
        assert (after.components, after.genus) == (before.components, before.genus)


def test_lengths_must_be_positive() -> None:
    field = Field(sphere())
    for length in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(UsageError, match="must be positive"):
            remesh(extracted(field, 16), field, length)
