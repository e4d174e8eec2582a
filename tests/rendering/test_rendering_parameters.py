"""The parameters of pictures: frozen, each in use, and those that are not passed are the defaults."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from parameter_checks import assert_frozen, field_names, read_attributes

import gnrecon.rendering
from gnrecon.geometry.mesh import Mesh
from gnrecon.rendering import render_sheet
from gnrecon.rendering.rays import Camera, shade, sphere_directions
from gnrecon.rendering.rendering_parameters import LightParameters, RenderingParameters, SheetParameters


@pytest.mark.parametrize("parameters", [RenderingParameters(), LightParameters(), SheetParameters()])
def test_they_are_frozen(parameters: object) -> None:
    assert_frozen(parameters)


@pytest.mark.parametrize("name", field_names(RenderingParameters))
def test_each_is_used(name: str) -> None:
    assert name in read_attributes(gnrecon.rendering, "rendering_parameters.py")


def test_shading_uses_its_parameters() -> None:
    normals, white, axes = np.eye(3), np.ones(3), np.eye(3)
    one = shade(normals, white, axes, 1.0)
    assert np.array_equal(one, shade(normals, white, axes, 1.0, parameters=LightParameters()))
    dark = shade(normals, white, axes, 1.0, parameters=LightParameters(exposure=3.0))
    assert (dark < one).all()


def test_directions_and_field_of_view_have_defaults() -> None:
    assert len(sphere_directions()) == RenderingParameters.light.sky_directions
    points = np.random.default_rng(0).normal(size=(20, 3))
    camera = Camera.framing(points, "front", "z", 40, 30)
    assert camera.field_of_view == RenderingParameters.field_of_view_degrees
    assert replace(camera, field_of_view=48.0).focal < camera.focal


def test_a_sheet_has_the_size_of_its_layout() -> None:
    mesh = Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]), [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    layout = SheetParameters(width=90, upper_height=40, lower_height=30, label_height=20)
    assert render_sheet(mesh, layout=layout).shape == (40 + 30 + 2 * 20, 90, 3)
