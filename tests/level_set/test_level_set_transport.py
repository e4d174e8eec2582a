"""The gradient of a loss over a moving surface, against finite differences of the surface integral itself.

The families are star-shaped or tori, so that their integrals are sums over rays: along each the surface is found by
bisection, and the sums (Gauss-Legendre in height, equal steps around) converge faster than any power.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest
import torch
from implicit_shapes import cube
from torch import Tensor
from torch.func import grad, jacrev, vmap

from gnrecon.level_set import LevelSet, derivative_along, sample_surface, transported
from gnrecon.residuals import Linearised, SecondOrder, eikonal, gauss_curvature, mean_curvature, surface_strain

Family = Callable[[Tensor, Tensor], Tensor]
"""f of theta and one point."""


def sphere(theta: Tensor, x: Tensor) -> Tensor:
    return theta[1] * (x.norm() - theta[0])


def ellipsoid(theta: Tensor, x: Tensor) -> Tensor:
    return (x[0] / theta[0]) ** 2 + (x[1] / theta[1]) ** 2 + x[2] ** 2 - 1


def bumpy(theta: Tensor, x: Tensor) -> Tensor:
    return x.square().sum() + theta[0] * x[0] * x[1] * x[2] - theta[1] * torch.exp(-x[2])


FAMILIES = {"sphere": (sphere, [0.7, 1.3]), "ellipsoid": (ellipsoid, [0.8, 1.3]), "bumpy": (bumpy, [0.5, 0.4])}
RESIDUALS = {"mean": mean_curvature, "gauss": gauss_curvature, "strain": surface_strain, "eikonal": eikonal}


class Rays(NamedTuple):
    directions: Tensor
    weights: Tensor


def rays(heights: int = 40, around: int = 60) -> Rays:
    z, weights = np.polynomial.legendre.leggauss(heights)
    angle = 2 * np.pi * (np.arange(around) + 0.5) / around
    ring = np.sqrt(1 - z**2)
    grid = np.stack(
        [np.outer(ring, np.cos(angle)), np.outer(ring, np.sin(angle)), np.outer(z, np.ones(around))], axis=-1
    )
    return Rays(torch.as_tensor(grid.reshape(-1, 3)), torch.as_tensor(np.repeat(weights * 2 * np.pi / around, around)))


def on_surface(f: Family, theta: Tensor) -> tuple[Tensor, Tensor]:
    """Points of the surface and the area that each stands for."""
    directions, weights = rays()
    low, high = torch.full_like(weights, 0.05), torch.full_like(weights, 3.0)
    values = vmap(f, (None, 0))
    for _ in range(60):
        middle = (low + high) / 2
        inside = values(theta, middle[:, None] * directions) < 0
        low, high = torch.where(inside, middle, low), torch.where(inside, high, middle)
    points = low[:, None] * directions
    gradient = vmap(grad(f, 1), (None, 0))(theta, points)
    cosine = (gradient * directions).sum(1) / gradient.norm(dim=1)
    return points, weights * low**2 / cosine


def linearised(name: str, f: Family, theta: Tensor, points: Tensor) -> tuple[Linearised, Tensor, Tensor]:
    """A residual at points, with grad f, (N, 3), and Hess f, (N, 3, 3)."""
    value = vmap(f, (None, 0))(theta, points)
    gradient = vmap(grad(f, 1), (None, 0))(theta, points)
    second = vmap(jacrev(grad(f, 1), 1), (None, 0))(theta, points)
    residual = RESIDUALS[name]
    if isinstance(residual, SecondOrder):
        return residual(value, gradient, second), gradient, second
    return residual(value, gradient, None), gradient, second


def loss(name: str, f: Family, theta: Tensor) -> float:
    points, areas = on_surface(f, theta)
    return 0.5 * float((areas * linearised(name, f, theta, points)[0].residual.square().sum(1)).sum())


def by_parameters(linear: Linearised, f: Family, theta: Tensor, points: Tensor) -> Tensor:
    """dr by theta, of shape (N, m, p), from the coefficients of df, d(grad f) and d(Hess f)."""
    total = torch.zeros(*linear.residual.shape, len(theta), dtype=points.dtype)
    if linear.by_value is not None:
        total = total + linear.by_value[:, :, None] * vmap(grad(f), (None, 0))(theta, points)[:, None]
    if linear.by_gradient is not None:
        total = total + torch.einsum(
            "nmi,nip->nmp", linear.by_gradient, vmap(jacrev(grad(f, 1)), (None, 0))(theta, points)
        )
    if linear.by_hessian is not None:
        turned = vmap(jacrev(jacrev(grad(f, 1), 1)), (None, 0))(theta, points)
        total = total + torch.einsum("nmij,nijp->nmp", linear.by_hessian, turned)
    return total


def loss_gradient(name: str, f: Family, theta: Tensor, points: Tensor, areas: Tensor, kept: str) -> Tensor:
    linear, gradient, second = linearised(name, f, theta, points)
    if kept != "none":
        curvature = mean_curvature(gradient[:, 0], gradient, second).residual[:, 0]
        normals = gradient / gradient.norm(dim=1, keepdim=True)
        along = derivative_along(lambda x: linearised(name, f, theta, x)[0].residual, points, normals, 1e-3)
        linear = transported(linear, gradient, curvature, along if kept == "full" else None)
    rows = by_parameters(linear, f, theta, points)
    return torch.einsum("n,nm,nmp->p", areas, linear.residual, rows)


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("name", RESIDUALS)
def test_the_gradient_is_that_of_the_surface_integral(name: str, family: str) -> None:
    f, start = FAMILIES[family]
    theta = torch.tensor(start, dtype=torch.float64)
    steps = 1e-4 * torch.eye(2, dtype=torch.float64)
    differences = torch.tensor([(loss(name, f, theta + s) - loss(name, f, theta - s)) / 2e-4 for s in steps])
    full = loss_gradient(name, f, theta, *on_surface(f, theta), "full")
    torch.testing.assert_close(full, differences.double(), atol=2e-6, rtol=2e-6)


def test_what_the_paper_keeps_is_not_that_gradient() -> None:
    theta = torch.tensor(FAMILIES["bumpy"][1], dtype=torch.float64)
    points, areas = on_surface(bumpy, theta)
    full, stretch, none = (
        loss_gradient("mean", bumpy, theta, points, areas, kept) for kept in ("full", "stretch", "none")
    )
    assert (none - full).norm() > 0.2 * full.norm()
    assert (stretch - full).norm() > 0.2 * full.norm()


def test_the_willmore_energy_of_spheres_does_not_depend_on_their_size() -> None:
    # The integral of (2 / R)^2 over a sphere is 16 pi: what the curvature loses, the area gains.
    theta = torch.tensor([0.7, 1.3], dtype=torch.float64)
    points, areas = on_surface(sphere, theta)
    assert loss("mean", sphere, theta) == pytest.approx(8 * np.pi, rel=1e-12)
    assert loss_gradient("mean", sphere, theta, points, areas, "full").abs().max() < 1e-7
    # The stretch alone is 1/2 (2 / R)^2 (2 / R) over the area, as the radius grows.
    stretch = loss_gradient("mean", sphere, theta, points, areas, "stretch")
    assert float(stretch[0]) == pytest.approx(16 * np.pi / 0.7, rel=1e-9)


def test_the_gauss_curvature_of_growing_spheres() -> None:
    # The integral of 1 / R^4 over a sphere is 4 pi / R^2; half of it changes by -4 pi / R^3.
    theta = torch.tensor([0.7, 1.3], dtype=torch.float64)
    gradient = loss_gradient("gauss", sphere, theta, *on_surface(sphere, theta), "full")
    assert gradient.tolist() == pytest.approx([-4 * np.pi / 0.7**3, 0], abs=1e-7)


@pytest.mark.seed(2267225981)
def test_it_holds_on_samples_of_the_level_set(rng: np.random.Generator) -> None:
    theta = torch.tensor(FAMILIES["bumpy"][1], dtype=torch.float64)
    surface = LevelSet(
        lambda x: vmap(bumpy, (None, 0))(theta, x),
        lambda x: (vmap(bumpy, (None, 0))(theta, x), vmap(grad(bumpy, 1), (None, 0))(theta, x)),
        cube(1.5),
    )
    sample = sample_surface(surface, 4000, rng)
    areas = torch.full((len(sample),), sample.area / len(sample), dtype=torch.float64)
    exact = loss_gradient("mean", bumpy, theta, *on_surface(bumpy, theta), "full")
    torch.testing.assert_close(
        loss_gradient("mean", bumpy, theta, sample.points, areas, "full"), exact, rtol=0.05, atol=0.05
    )


def test_nothing_moves_at_a_critical_point() -> None:
    linear = Linearised(torch.ones(2, 1), None, torch.zeros(2, 1, 3))
    gradient = torch.tensor([[0.0, 0, 0], [0, 0, 2.0]])
    moved = transported(linear, gradient, torch.tensor([1.0, 3.0]), torch.full((2, 1), 0.5))
    assert moved.by_value is not None
    assert moved.by_value[:, 0].tolist() == [0.0, -1.0]
