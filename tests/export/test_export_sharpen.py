"""Sharpening puts the edges and corners back that marching cubes cuts off, and leaves smooth shapes alone."""

from __future__ import annotations

import numpy as np
import pytest
from analytic_fields import UTM, Field, sphere, torus
from sharp_fields import (
    HALF,
    TURN,
    between,
    box,
    cylinder,
    extracted,
    lens,
    notched_box,
    to_box_edges,
    to_cylinder_edges,
    to_lens_edge,
)

from gnrecon.export import project, require_sound, sharpen
from gnrecon.export.remeshing.sharpen import meeting_points


@pytest.mark.parametrize(
    ("function", "distance"), [(box, to_box_edges), (cylinder, to_cylinder_edges), (lens, to_lens_edge)]
)
def test_chamfers_go(function, distance) -> None:  # type: ignore[no-untyped-def]
    field = Field(function())
    plain = extracted(field)
    sharp = sharpen(plain, field)
    new = sharp.vertices[len(plain.vertices) :]
    assert np.array_equal(sharp.vertices[: len(plain.vertices)], plain.vertices)
    assert np.quantile(distance(new), 0.9) < 1e-5, "nearly all new vertices lie on the edge"
    before, after = (np.abs(field.sdf(between(mesh))) for mesh in (plain, project(sharp, field)))
    near = [distance(between(mesh)) < 0.1 for mesh in (plain, project(sharp, field))]
    assert after[near[1]].mean() < 0.3 * before[near[0]].mean()
    assert require_sound(project(sharp, field)).genus == 0


def test_a_box_has_its_corners_and_its_volume() -> None:
    field = Field(box(), frame=UTM)
    plain = extracted(field)
    sharp = project(sharpen(plain, field), field)
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * HALF @ TURN.T
    places = UTM.to_unit(sharp.vertices)
    nearest = np.linalg.norm(places[:, None] - corners, axis=2).min(axis=0)
    assert np.median(nearest) < 1e-5
    volume = 8 * HALF.prod() * UTM.scale**3
    assert abs(plain.volume / volume - 1) > 3e-3
    assert abs(sharp.volume / volume - 1) < 2e-4


def test_concave_edges_too() -> None:
    field = Field(notched_box())
    plain = extracted(field, 48)
    sharp = project(sharpen(plain, field), field)
    before, after = (np.abs(field.sdf(between(mesh))) for mesh in (plain, sharp))
    assert after.mean() < 0.3 * before.mean()
    require_sound(sharp)


@pytest.mark.parametrize("function", [sphere(), torus()])
def test_smooth_shapes_stay_as_they_are(function) -> None:  # type: ignore[no-untyped-def]
    field = Field(function)
    plain = extracted(field, 48)
    assert sharpen(plain, field) is plain


def test_a_bend_tighter_than_the_lattice_is_followed_better() -> None:
    """Between two vertices, a thin tube turns as much as an edge does; what is added there lies on the tube."""
    field = Field(torus(0.6, 0.12))
    plain = extracted(field, 32)
    bent = project(sharpen(plain, field), field)
    assert len(bent.faces) > len(plain.faces)
    assert np.abs(field.sdf(bent.vertices)).max() < 1e-6
    assert np.abs(field.sdf(between(bent))).mean() < np.abs(field.sdf(between(plain))).mean()
    assert require_sound(bent).genus == 1


def test_a_point_goes_where_planes_and_curved_sides_meet() -> None:
    field = Field(cylinder())
    angle = np.linspace(0, 6, 20)
    ring = np.stack([0.6 * np.cos(angle), 0.6 * np.sin(angle), np.full(20, 0.5)], axis=1)
    wall, lid = ring - [0, 0, 0.08], ring * [0.9, 0.9, 1]
    owners = np.tile(np.arange(20), 2)
    points = meeting_points(0.5 * (wall + lid) @ TURN.T, owners, np.concatenate([wall, lid]) @ TURN.T, field, 30.0)
    assert np.abs(to_cylinder_edges(points)).max() < 1e-6


def test_no_face_folds_over() -> None:
    field = Field(box())
    sharp = sharpen(extracted(field), field)
    normals = field.gradient(sharp.corners.mean(axis=1))
    along = np.einsum("ij,ij->i", sharp.face_vectors, normals)
    assert (along < 0).mean() < 1e-3
