"""The distance to a mesh, and surfaces extracted at a distance from it."""

from __future__ import annotations

import numpy as np
import pytest
from analytic_fields import UNIT, UTM, Field, shells, sphere, torus

from gnrecon.export import extract, project, require_sound
from gnrecon.export.metrics import SurfaceQuery, nearest_on_surface
from gnrecon.export.offset import OffsetField
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import Frame
from gnrecon.runtime.errors import UsageError

RESOLUTION = 32


def meshed(field: Field) -> Mesh:
    return project(extract(field, resolution=RESOLUTION), field)


def around(mesh: Mesh, reach: float) -> np.ndarray:
    return np.stack([mesh.vertices.min(axis=0) - reach, mesh.vertices.max(axis=0) + reach])


@pytest.mark.parametrize("frame", [UNIT, UTM], ids=["unit", "UTM"])
def test_the_distance_of_a_torus(frame: Frame, rng: np.random.Generator) -> None:
    field = Field(torus(), frame=frame)
    mesh = meshed(field)
    distance = OffsetField(mesh, 0.1 * frame.scale, frame, field.bounds)
    points = frame.to_world(rng.uniform(-1, 1, (500, 3)))
    chord = (2.2 / RESOLUTION) ** 2 / (8 * 0.2) * 3
    assert np.abs(distance.distance(points) - field.sdf(points)).max() < chord * frame.scale
    assert np.allclose(distance.sdf(points), distance.distance(points) - 0.1 * frame.scale)


def test_the_sign_in_a_shell_within_a_shell(rng: np.random.Generator) -> None:
    field = Field(shells())
    points = rng.uniform(-1, 1, (5000, 3))
    truth = field.sdf(points)
    clear = np.abs(truth) > 0.02
    inside = SurfaceQuery(meshed(field)).inside(points)
    assert np.array_equal(inside[clear], truth[clear] < 0)


def test_the_nearest_point_agrees_with_a_slow_search(rng: np.random.Generator) -> None:
    import trimesh

    mesh = extract(Field(sphere()), resolution=8)
    points = rng.uniform(-1, 1, (50, 3))
    feet, faces = SurfaceQuery(mesh, batch=7).nearest(points)
    slow = np.array(
        [
            np.linalg.norm(
                trimesh.triangles.closest_point(mesh.corners, np.repeat(point[None], len(mesh.faces), axis=0)) - point,
                axis=1,
            ).min()
            for point in points
        ]
    )
    assert np.allclose(np.linalg.norm(feet - points, axis=1), slow, rtol=0, atol=1e-6)
    assert np.array_equal(nearest_on_surface(mesh, points)[1], faces)


def test_the_gradient_is_the_slope_of_the_distance(rng: np.random.Generator) -> None:
    mesh = meshed(Field(sphere()))
    field = OffsetField(mesh, 0.1, UNIT, around(mesh, 0.2))
    points = rng.normal(size=(40, 3))
    points *= rng.uniform(0.4, 1.0, (40, 1)) / np.linalg.norm(points, axis=1, keepdims=True)
    gradient = field.gradient(points)
    assert np.allclose(np.linalg.norm(gradient, axis=1), 1)
    ahead = field.sdf(points + 1e-3 * gradient) - field.sdf(points - 1e-3 * gradient)
    assert np.allclose(ahead, 2e-3, rtol=0.02)
    on_mesh = field.gradient(mesh.vertices[:20])
    assert np.isfinite(on_mesh).all()
    assert (np.einsum("ij,ij->i", on_mesh, mesh.vertices[:20]) > 0).all()


@pytest.mark.parametrize("level", [-0.1, 0.15])
def test_a_surface_at_a_distance(level: float) -> None:
    mesh = meshed(Field(sphere()))
    field = OffsetField(mesh, level, UNIT, around(mesh, max(level, 0) + 0.2))
    surface = project(extract(field, resolution=RESOLUTION), field)
    require_sound(surface)
    assert np.abs(nearest_on_surface(mesh, surface.vertices)[0] - abs(level)).max() < 1e-3
    radii = np.linalg.norm(surface.vertices, axis=1)
    assert np.abs(radii - (0.8 + level)).max() < 2e-3


def test_levels_within_rounding_of_the_surface_are_refused() -> None:
    mesh = extract(Field(sphere()), resolution=8)
    for level in (0.0, 1e-7, -1e-7, float("nan")):
        with pytest.raises(UsageError, match="too small for this shape"):
            OffsetField(mesh, level, UNIT, around(mesh, 1.0))
