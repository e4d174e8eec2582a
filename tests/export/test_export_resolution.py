"""Edge lengths and chord errors: what is asked for is what is found, by exact geometry."""

from __future__ import annotations

import numpy as np
import pytest
from analytic_fields import UTM, Field, sphere, torus

from gnrecon.export import extract, project
from gnrecon.export.resolution import (
    cells_for_edges,
    chord_error,
    measure_fineness,
    projected_chord_error,
    refined_resolution,
)
from gnrecon.runtime.errors import UsageError

RADIUS = 0.8


@pytest.mark.parametrize("length", [0.9, 2.5])
@pytest.mark.parametrize("function", [sphere(RADIUS), torus()], ids=["sphere", "torus"])
def test_edges_are_as_long_as_was_asked(function: object, length: float) -> None:
    field = Field(function, frame=UTM)  # type: ignore[arg-type]
    cells = cells_for_edges(length, field.bounds)
    mesh = project(extract(field, resolution=cells), field)
    fineness = measure_fineness(mesh, field, cells, field.bounds)
    a, b = mesh.vertices[mesh.faces], mesh.vertices[np.roll(mesh.faces, -1, axis=1)]
    assert fineness.edge_length == pytest.approx(np.linalg.norm(a - b, axis=2).mean(), rel=1e-5)
    assert fineness.edge_length == pytest.approx(length, rel=0.1)
    assert fineness.as_dict() == {
        "resolution": cells,
        "edge_length": fineness.edge_length,
        "chord_error": fineness.chord_error,
    }
    assert f"{cells} cells" in fineness.describe()


def test_absurd_edges_are_refused_with_lengths_that_are_possible() -> None:
    bounds = np.array([[0.0, 0, 0], [10, 20, 5]])
    for length in (1e-6, 50.0):
        with pytest.raises(UsageError, match=r"a length from (\S+) to (\S+)\.") as refused:
            cells_for_edges(length, bounds)
        words = str(refused.value).rstrip(".").split()
        assert cells_for_edges(float(words[-3]), bounds) > 4000
        assert cells_for_edges(float(words[-1]), bounds) == 16


def test_the_chord_error_is_that_of_the_sphere() -> None:
    field = Field(sphere(RADIUS), frame=UTM)
    mesh = project(extract(field, resolution=20), field)
    corners = UTM.to_unit(mesh.vertices)[mesh.faces]
    points = np.concatenate([corners.mean(axis=1), *((corners + np.roll(corners, 1, axis=1)) / 2).swapaxes(0, 1)])
    exact = UTM.scale * np.abs(np.linalg.norm(points, axis=1) - RADIUS)
    found = chord_error(mesh, field, field.bounds, 0.1)
    assert np.quantile(exact, 0.998) <= found * 1.0001
    assert found <= exact.max() * 1.0001


def test_a_steep_field_has_the_same_chord_error() -> None:
    errors = []
    for factor in (1.0, 30.0):
        field = Field(lambda x, factor=factor: factor * torus()(x))
        mesh = project(extract(Field(torus()), resolution=24), field)
        errors.append(chord_error(mesh, field, field.bounds, 0.1))
    assert errors[0] == pytest.approx(errors[1], rel=1e-4)


def test_the_error_is_known_before_the_mesh_is_projected() -> None:
    field = Field(torus())
    # A coarse copy of the field, as single precision may be one, puts vertices off the surface.
    rough = extract(Field(torus(minor=0.21)), resolution=32)
    before = projected_chord_error(rough, field, 32, field.bounds)
    assert before == pytest.approx(chord_error(project(rough, field, steps=2), field, field.bounds, 2.2 / 32), rel=0.05)
    assert before < 0.9 * chord_error(rough, field, field.bounds, 2.2 / 32)


def test_caps_have_no_chord_error() -> None:
    field = Field(sphere(1.3), reach=1.0)
    cell = 2.0 / 40
    mesh = project(extract(field, resolution=40), field)
    on_caps = np.abs(field.sdf(mesh.vertices)).max()
    assert on_caps > 0.1
    assert chord_error(mesh, field, field.bounds, cell) < 0.01
    everywhere = Field(lambda x: np.full(len(x), -1.0))
    assert chord_error(extract(everywhere, resolution=16), everywhere, everywhere.bounds, 2.2 / 16) == 0.0


def test_the_next_resolution_follows_the_square_law() -> None:
    assert refined_resolution(100, 4e-3, 1e-3) == 221
    assert refined_resolution(100, 1.01e-3, 1e-3) == 120
    assert refined_resolution(100, 1.0, 1e-9) == 300
    field = Field(torus())
    errors = [
        projected_chord_error(extract(field, resolution=n), field, n, field.bounds)
        for n in (32, refined_resolution(32, 1.0, 0.3))
    ]
    assert errors[1] < 0.3 * errors[0] * 1.2
