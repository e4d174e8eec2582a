"""The parameters of pictures: frozen, each in use, and those that are not passed are the defaults."""

from __future__ import annotations

import ast
from dataclasses import FrozenInstanceError, fields, is_dataclass, replace
from pathlib import Path

import numpy as np
import pytest

import gnrecon.rendering
from gnrecon.geometry.mesh import Mesh
from gnrecon.rendering import render_sheet
from gnrecon.rendering.rays import Camera, shade, sphere_directions
from gnrecon.rendering.rendering_parameters import LightParameters, RenderingParameters, SheetParameters


def names(parameters: type) -> list[str]:
    """All fields, those of nested parameters included."""
    found = []
    for field in fields(parameters):
        found.append(field.name)
        value = getattr(parameters(), field.name)
        if is_dataclass(value):
            found += names(type(value))
    return found


@pytest.mark.parametrize("parameters", [RenderingParameters(), LightParameters(), SheetParameters()])
def test_they_are_frozen(parameters: object) -> None:
    with pytest.raises(FrozenInstanceError):
        setattr(parameters, fields(parameters)[0].name, 1)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", names(RenderingParameters))
def test_each_is_used(name: str) -> None:
    room = Path(gnrecon.rendering.__file__).parent
    sources = [path for path in room.rglob("*.py") if path.name != "rendering_parameters.py"]
    trees = [ast.parse(path.read_text(encoding="utf-8")) for path in sources]
    assert any(isinstance(node, ast.Attribute) and node.attr == name for tree in trees for node in ast.walk(tree))


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
