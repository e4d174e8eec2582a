"""Lighter copies for looking at, and the sky that vertices see."""

from __future__ import annotations

import numpy as np
import pytest
from analytic_fields import UTM, Field, ball_mesh, sphere, union

from gnrecon.export import decimate_by_clustering, extract, project
from gnrecon.export.remeshing.decimate import barycentric
from gnrecon.geometry.mesh import Mesh
from gnrecon.rendering import vertex_ambient_occlusion


@pytest.fixture(scope="module")
def ball() -> Mesh:
    mesh = ball_mesh(resolution=48)
    unit = UTM.to_unit(mesh.vertices)
    colors = np.uint8(np.round(127 + 100 * unit))
    return mesh.with_attributes({"height": unit[:, 2], "colors": colors, "label": np.int32(unit[:, 0] > 0)})


def test_a_light_copy_has_few_faces_and_lies_on_the_surface(ball: Mesh) -> None:
    light = decimate_by_clustering(ball, 1000)
    assert len(light.faces) <= 1000
    unit = UTM.to_unit(light.vertices)
    assert np.abs(np.linalg.norm(unit, axis=1) - 0.8).max() < 0.01
    assert light.volume == pytest.approx(ball.volume, rel=0.02)
    assert light.normals is not None
    assert np.abs(np.linalg.norm(light.normals, axis=1) - 1).max() < 1e-12
    assert np.einsum("ij,ij->i", light.normals, unit / np.linalg.norm(unit, axis=1, keepdims=True)).min() > 0.99


def test_attributes_follow_in_their_types(ball: Mesh) -> None:
    light = decimate_by_clustering(ball, 1000)
    unit = UTM.to_unit(light.vertices)
    assert np.abs(light.attributes["height"] - unit[:, 2]).max() < 0.01
    assert light.attributes["colors"].dtype == np.uint8
    assert np.abs(light.attributes["colors"] - (127 + 100 * unit)).max() < 3
    assert light.attributes["label"].dtype == np.int32
    assert set(np.unique(light.attributes["label"])) == {0, 1}


def test_a_light_mesh_is_left_alone(ball: Mesh) -> None:
    assert decimate_by_clustering(ball, len(ball.faces)) is ball


def test_the_open_side_of_a_ball_sees_the_sky_and_the_gap_does_not() -> None:
    field = Field(union(sphere(0.4, (-0.42, 0, 0)), sphere(0.4, (0.42, 0, 0))), frame=UTM)
    mesh = project(extract(field, resolution=48), field)
    sky = vertex_ambient_occlusion(mesh)
    across = np.abs(UTM.to_unit(mesh.vertices)[:, 0])
    assert sky.shape == (len(mesh.vertices),)
    assert sky[across > 0.75].min() > 0.97
    assert sky[across < 0.06].max() < 0.6
    assert sky.min() >= 0
    assert sky.max() <= 1


def test_places_are_the_mixtures_that_their_shares_say(rng: np.random.Generator) -> None:
    corners, shares = rng.normal(size=(50, 3, 3)), rng.dirichlet(np.ones(3), 50)
    places = np.einsum("nk,nki->ni", shares, corners)
    assert np.allclose(barycentric(corners, places), shares)
    assert np.allclose(barycentric(np.ones((1, 3, 3)), np.ones((1, 3))), 1 / 3)
