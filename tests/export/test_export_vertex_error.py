"""The error map, against shapes whose distance is known."""

from __future__ import annotations

import numpy as np
import pytest
from analytic_fields import UTM, Field, ball_mesh, torus

from gnrecon.export import extract, vertex_error
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import PointCloud


def ball(radius: float, resolution: int = 32) -> Mesh:
    return ball_mesh(radius, resolution=resolution)


@pytest.fixture(scope="module")
def truth() -> Mesh:
    return ball(0.8, 64)


@pytest.mark.parametrize("radius", [0.7, 0.78, 0.85])
def test_balls_of_other_sizes_are_off_by_the_difference(truth: Mesh, radius: float) -> None:
    found = vertex_error(ball(radius), truth)
    # The reference's faces are chords, a little within the sphere.
    assert np.abs(found - UTM.scale * (radius - 0.8)).max() < 0.002 * UTM.scale


def test_the_sign_needs_neither_faces_turned_outward_nor_a_closed_reference(truth: Mesh) -> None:
    smaller = ball(0.75)
    inward = Mesh(truth.vertices, truth.faces[:, ::-1])
    assert np.abs(vertex_error(smaller, truth) - vertex_error(smaller, inward)).max() < 1e-5
    half = Mesh(truth.vertices, truth.faces[truth.corners[:, :, 2].min(axis=1) > UTM.center[2]])
    assert (vertex_error(smaller, half)[smaller.vertices[:, 2] > UTM.center[2] + 1] < 0).all()


def test_points_serve_as_a_reference(truth: Mesh) -> None:
    found = vertex_error(ball(0.9), PointCloud(truth.vertices))
    spacing = UTM.scale * 2 * 1.1 / 64
    assert (found >= UTM.scale * 0.1 - 1e-9).all()
    assert (found < np.hypot(UTM.scale * 0.1, spacing)).all()


def test_errors_are_those_of_a_slow_search(rng: np.random.Generator) -> None:
    reference = ball(0.6, 16)
    field = Field(torus(), frame=UTM)
    mesh = extract(field, resolution=24)
    some = rng.choice(len(mesh.vertices), 60, replace=False)
    found = vertex_error(mesh, reference)[some]
    # Distances to many places of every face are never smaller, and nearly as small.
    weights = rng.dirichlet(np.ones(3), 400)
    places = np.einsum("nk,fki->fni", weights, reference.corners).reshape(-1, 3)
    slow = np.array([np.linalg.norm(places - point, axis=1).min() for point in mesh.vertices[some]])
    assert (np.abs(found) <= slow + 1e-9).all()
    assert (np.abs(found) > slow - 0.3).all()
