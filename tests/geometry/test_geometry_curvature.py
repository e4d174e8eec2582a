"""Curvatures of level sets whose curvature is known, through second derivatives by automatic differentiation."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.func import grad, jacrev, vmap

from gnrecon.export import curvatures
from gnrecon.field import Siren
from gnrecon.fit import NeuralSDF
from gnrecon.geometry.point_cloud import Frame
from gnrecon.geometry.signed_distance import Box

RING, TUBE = 1.0, 0.3


def of(function: Callable[[Tensor], Tensor], points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    x = torch.as_tensor(points)
    return curvatures(vmap(grad(function))(x).numpy(), vmap(jacrev(grad(function)))(x).numpy())


def torus_polynomial(x: Tensor) -> Tensor:
    """Zero on the torus and nothing of a distance: its gradient is far from one."""
    return (x @ x + RING**2 - TUBE**2) ** 2 - 4 * RING**2 * (x[0] ** 2 + x[1] ** 2)


def torus_points(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Points, and the cosine of the angle around the tube, which is one at the outer rim."""
    u, v = rng.uniform(0, 2 * np.pi, (2, 200))
    out = RING + TUBE * np.cos(v)
    return np.column_stack([out * np.cos(u), out * np.sin(u), TUBE * np.sin(v)]), np.cos(v)


@pytest.mark.parametrize("radius", [0.2, 3.0])
def test_a_sphere_is_convex(radius: float, rng: np.random.Generator) -> None:
    points = rng.normal(size=(50, 3))
    points *= radius / np.linalg.norm(points, axis=1, keepdims=True)
    for function in (lambda x: x.norm() - radius, lambda x: 5 * (x @ x - radius**2)):
        mean, gauss = of(function, points)
        assert mean == pytest.approx(1 / radius)
        assert gauss == pytest.approx(1 / radius**2)
    # Seen from the other side it is hollow; the Gauss curvature knows no side.
    mean, gauss = of(lambda x: radius**2 - x @ x, points)
    assert mean == pytest.approx(-1 / radius)
    assert gauss == pytest.approx(1 / radius**2)


def test_a_torus(rng: np.random.Generator) -> None:
    points, cosine = torus_points(rng)
    mean, gauss = of(torus_polynomial, points)
    out = RING + TUBE * cosine
    assert mean == pytest.approx((RING + 2 * TUBE * cosine) / (2 * TUBE * out))
    assert gauss == pytest.approx(cosine / (TUBE * out))


def test_a_plane_a_cylinder_and_a_saddle() -> None:
    at = np.array([[2.0, 0, 0]])
    assert [float(value[0]) for value in of(lambda x: 3 * x[0] - 6, at)] == [0, 0]
    mean, gauss = of(lambda x: x[0] ** 2 + x[2] ** 2 - 4, at)
    assert (mean[0], gauss[0]) == pytest.approx((0.25, 0))
    mean, gauss = of(lambda x: x[2] - x[0] * x[1], np.zeros((1, 3)))
    assert (mean[0], gauss[0]) == pytest.approx((0, -1))


def test_there_is_none_where_the_gradient_vanishes() -> None:
    mean, gauss = curvatures(np.zeros((1, 3)), np.eye(3)[None])
    assert np.isnan([mean[0], gauss[0]]).all()


def bowl(frequency: float) -> tuple[Siren, Tensor]:
    """A sine network that is |x|^2 up to frequency^2 / 12: each unit is a cosine along one axis."""
    field = Siren((3,))
    top = torch.full((1, 3), -2 / frequency**2, dtype=torch.float64)
    layers = [
        (frequency * torch.eye(3, dtype=torch.float64), torch.full((3,), torch.pi / 2, dtype=torch.float64)),
        (top, torch.tensor([6 / frequency**2], dtype=torch.float64)),
    ]
    return field, field.layout.flatten(layers)


@pytest.mark.parametrize("kind", [torch.float64, torch.float32])
def test_curvature_is_in_file_units(kind: torch.dtype, rng: np.random.Generator) -> None:
    frame = Frame(np.array([500_000.0, 4_500_000.0, 100.0]), 20.0)
    field, theta = bowl(0.1)
    box = Box(np.full(3, -1.0), np.full(3, 1.0))
    sdf = NeuralSDF(field, theta.to(kind), frame, box)
    directions = rng.normal(size=(40, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    points = frame.center + 10 * directions
    gradient = NeuralSDF(field, theta, frame, box).gradient(points)
    mean, gauss = curvatures(gradient, sdf.hessian(points))
    assert mean == pytest.approx(np.full(40, 1 / 10), rel=3e-3)
    assert gauss == pytest.approx(np.full(40, 1 / 100), rel=6e-3)
    assert sdf.hessian(np.empty((0, 3))).shape == (0, 3, 3)
