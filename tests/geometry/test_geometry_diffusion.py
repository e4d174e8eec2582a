"""Diffusion over a surface: what is constant or linear stays, what oscillates fades as the heat equation says."""

from __future__ import annotations

import numpy as np
import pytest
from analytic_fields import Field, sphere

from gnrecon.export import extract
from gnrecon.geometry.curvature import diffuse, vertex_areas
from gnrecon.geometry.mesh import Mesh

RADIUS = 0.8


@pytest.fixture(scope="module")
def ball() -> Mesh:
    return extract(Field(sphere(RADIUS)), resolution=40)


def test_areas_add_up(ball: Mesh) -> None:
    assert vertex_areas(ball).sum() == pytest.approx(ball.area)


def test_a_constant_stays_and_the_mean_does(ball: Mesh, rng: np.random.Generator) -> None:
    count = len(ball.vertices)
    assert diffuse(ball, np.full(count, 3.0), 0.2) == pytest.approx(3)
    noise, areas = rng.normal(size=count), vertex_areas(ball)
    smooth = diffuse(ball, noise, 0.2)
    assert areas @ smooth == pytest.approx(areas @ noise, abs=1e-4)
    assert smooth.std() < 0.2 * noise.std()


@pytest.mark.parametrize("width", [0.1, 0.4])
@pytest.mark.parametrize("axes", [(2,), (0, 1), (0, 1, 2)])
def test_harmonics_of_a_sphere_fade_as_one_implicit_step_says(ball: Mesh, width: float, axes: tuple[int, ...]) -> None:
    # The product of l different coordinates is a harmonic of degree l.
    degree, values = len(axes), ball.vertices[:, axes].prod(axis=1)
    # The Laplacian's eigenvalue is l (l + 1) / r^2.
    expected = values / (1 + width**2 / 2 * degree * (degree + 1) / RADIUS**2)
    assert np.abs(diffuse(ball, values, width) - expected).max() < 0.02 * np.abs(values).max()


def test_linear_values_on_a_plane_stay_however_it_is_cut_into_triangles(rng: np.random.Generator) -> None:
    from scipy.spatial import Delaunay

    flat = rng.uniform(-1, 1, (800, 2))
    mesh = Mesh(np.column_stack([flat, np.zeros(800)]), Delaunay(flat).simplices)
    values = flat @ [1.0, -2.0]
    inner = np.abs(flat).max(axis=1) < 0.5
    assert np.abs(diffuse(mesh, values, 0.05) - values)[inner].max() < 1e-3
