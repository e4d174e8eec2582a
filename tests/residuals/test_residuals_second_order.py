"""Residuals of curvature: analytic values on known surfaces, and derivatives against nested autodiff."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.func import grad, jacrev, vmap

from gnrecon.field import ACTIVATIONS, Network
from gnrecon.least_squares import LayerRows
from gnrecon.residuals import (
    SecondOrder,
    clipped_strain,
    from_formula,
    gauss_curvature,
    mean_curvature,
    surface_strain,
    tangents,
)
from gnrecon.residuals.constraints import tangent_frame

F64 = torch.float64
Function = Callable[[Tensor], Tensor]

seeds = given(seed=st.integers(0, 2**32 - 1))
few = settings(max_examples=5, deadline=None)


def shape_operator(g: Tensor, H: Tensor) -> Tensor:
    """P H P / |g| from its definition, at one point."""
    n = g / g.norm()
    P = torch.eye(3, dtype=g.dtype) - torch.outer(n, n)
    return P @ H @ P / g.norm()


def principal(g: Tensor, H: Tensor) -> tuple[Tensor, Tensor]:
    """Sum and sum of squares of the principal curvatures, from the shape operator's trace and square."""
    S = shape_operator(g, H)
    return S.trace(), (S @ S).trace()


# Formulas of one point, with the frame that is held fixed.
FORMULAS: dict[str, Callable[[Tensor, Tensor, Tensor], Tensor]] = {
    "mean curvature": lambda g, H, _: principal(g, H)[0][None],
    "Gauss curvature": lambda g, H, _: ((principal(g, H)[0] ** 2 - principal(g, H)[1]) / 2)[None],
    "surface strain": lambda g, H, T: (
        (T.mT @ shape_operator(g, H) @ T).flatten()[[0, 1, 3]] * torch.tensor([1.0, math.sqrt(2.0), 1.0], dtype=F64)
    ),
}
each_residual = pytest.mark.parametrize(
    "residual", [mean_curvature, gauss_curvature, surface_strain], ids=lambda r: r.name
)


def sphere(x: Tensor) -> Tensor:
    return (x @ x).sqrt() - 0.5


def ellipsoid_equation(x: Tensor) -> Tensor:
    return x @ x - 0.25


def cylinder(x: Tensor) -> Tensor:
    return (x[0] ** 2 + x[1] ** 2).sqrt() - 0.4


def plane(x: Tensor) -> Tensor:
    return 3 * (x[0] + 2 * x[1] - 0.3)


def saddle(x: Tensor) -> Tensor:
    return x[2] - (x[0] ** 2 - x[1] ** 2)


def torus(x: Tensor) -> Tensor:
    return (((x[0] ** 2 + x[1] ** 2).sqrt() - 1.0) ** 2 + x[2] ** 2).sqrt() - 0.3


# A field, a point of its surface, k1 and k2 there: spheres are umbilic everywhere, a plane and a saddle's middle flat.
SURFACES: dict[str, tuple[Function, list[float], tuple[float, float]]] = {
    "sphere": (sphere, [0.0, 0.3, -0.4], (2.0, 2.0)),
    "sphere, no distance": (ellipsoid_equation, [0.5, 0.0, 0.0], (2.0, 2.0)),
    "cylinder": (cylinder, [0.0, 0.4, 0.7], (2.5, 0.0)),
    "plane": (plane, [0.1, 0.1, 5.0], (0.0, 0.0)),
    "saddle": (saddle, [0.0, 0.0, 0.0], (2.0, -2.0)),
    "outside of a torus": (torus, [1.3, 0.0, 0.0], (1 / 0.3, 1 / 1.3)),
    "inside of a torus": (torus, [0.0, 0.7, 0.0], (1 / 0.3, -1 / 0.7)),
    "top of a torus": (torus, [0.0, 1.0, 0.3], (1 / 0.3, 0.0)),
}
each_surface = pytest.mark.parametrize("name", SURFACES)


def at(function: Function, point: list[float]) -> tuple[Tensor, Tensor, Tensor]:
    x = torch.tensor(point, dtype=F64)
    return function(x)[None], grad(function)(x)[None], jacrev(grad(function))(x)[None]


@each_surface
def test_known_surfaces(name: str) -> None:
    function, point, (k1, k2) = SURFACES[name]
    value, gradient, hessian = at(function, point)
    assert abs(float(value)) < 1e-12
    mean = mean_curvature(value, gradient, hessian).residual
    gauss = gauss_curvature(value, gradient, hessian).residual
    strain = surface_strain(value, gradient, hessian).residual
    torch.testing.assert_close(mean, torch.tensor([[k1 + k2]], dtype=F64), rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(gauss, torch.tensor([[k1 * k2]], dtype=F64), rtol=1e-12, atol=1e-12)
    assert strain.shape == (1, 3)
    torch.testing.assert_close(strain.square().sum(), torch.tensor(k1**2 + k2**2, dtype=F64), rtol=1e-12, atol=1e-12)


@each_surface
@each_residual
def test_derivatives_are_finite_on_known_surfaces(name: str, residual: SecondOrder) -> None:
    linear = residual(*at(SURFACES[name][0], SURFACES[name][1]))
    assert linear.by_gradient is not None
    assert linear.by_hessian is not None
    assert bool(linear.by_gradient.isfinite().all())
    assert bool(linear.by_hessian.isfinite().all())
    # Flat points are where a norm of the strain would have no derivative; the entries have.
    assert float(linear.by_hessian.abs().max()) > 0 or residual is gauss_curvature


@each_residual
@few
@seeds
def test_derivatives_agree_with_autodiff(residual: SecondOrder, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    value = torch.zeros(9, dtype=F64)
    gradient = torch.randn(9, 3, generator=generator, dtype=F64)
    hessian = torch.randn(9, 3, 3, generator=generator, dtype=F64)
    hessian = hessian + hessian.mT
    frames = tangent_frame(gradient / gradient.norm(dim=1, keepdim=True))
    formula = FORMULAS[residual.name]
    linear = residual(value, gradient, hessian)
    assert linear.by_value is None
    torch.testing.assert_close(linear.residual, vmap(formula)(gradient, hessian, frames), rtol=1e-9, atol=1e-9)
    by_gradient, by_hessian = vmap(jacrev(formula, argnums=(0, 1)))(gradient, hessian, frames)
    torch.testing.assert_close(linear.by_gradient, by_gradient, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(linear.by_hessian, (by_hessian + by_hessian.mT) / 2, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    "residual", [mean_curvature, gauss_curvature, surface_strain, clipped_strain(2.0)], ids=lambda r: r.name
)
@few
@seeds
def test_curvatures_are_tangential(residual: SecondOrder, seed: int) -> None:
    assert residual.tangential
    generator = torch.Generator().manual_seed(seed)
    gradient = torch.randn(9, 3, generator=generator, dtype=F64)
    hessian = torch.randn(9, 3, 3, generator=generator, dtype=F64)
    hessian = hessian + hessian.mT
    n = torch.nn.functional.normalize(gradient, dim=1)
    across = 5.0 * n[:, :, None] * n[:, None, :]
    value = torch.zeros(9, dtype=F64)
    linear, other = residual(value, gradient, hessian), residual(value, gradient, hessian + across)
    torch.testing.assert_close(other.residual, linear.residual, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(other.by_gradient, linear.by_gradient, rtol=1e-9, atol=1e-9)
    assert linear.by_hessian is not None
    assert float((linear.by_hessian @ n[:, None, :, None]).abs().max()) < 1e-9
    first, second = tangents(gradient)
    for one, other_one, product in ((first, first, 1.0), (second, second, 1.0), (first, second, 0.0), (first, n, 0.0)):
        torch.testing.assert_close((one * other_one).sum(1), torch.full((9,), product, dtype=F64))


@each_residual
def test_the_rate_is_the_derivative_along_a_change(residual: SecondOrder) -> None:
    generator = torch.Generator().manual_seed(0)
    value, gradient = torch.zeros(9, dtype=F64), torch.randn(9, 3, generator=generator, dtype=F64)
    hessian, change = torch.randn(2, 9, 3, 3, generator=generator, dtype=F64)
    hessian, change = hessian + hessian.mT, change + change.mT
    linear = residual(value, gradient, hessian)
    h = 1e-6
    ahead, behind = (residual(value, gradient, hessian + side * change).residual for side in (h, -h))
    rate = linear.rate(value, torch.zeros_like(gradient), change)
    torch.testing.assert_close(rate, (ahead - behind) / (2 * h), rtol=1e-6, atol=1e-6)
    if residual is not surface_strain:  # its frame turns with the gradient
        ahead, behind = (residual(value, gradient + side * change[:, 0], hessian).residual for side in (h, -h))
        rate = linear.rate(value, change[:, 0], None)
        torch.testing.assert_close(rate, (ahead - behind) / (2 * h), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("activation", ACTIVATIONS)
@each_residual
@few
@seeds
def test_rows_of_a_network_agree_with_nested_autodiff(activation: str, residual: SecondOrder, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    kind = ACTIVATIONS[activation]
    network = Network((4, 5), kind, (1.0,) * kind.inputs)
    theta = 0.7 * torch.randn(network.layout.count, generator=generator, dtype=F64)
    x = torch.randn(3, 3, generator=generator, dtype=F64)
    jet = network.curved_jet(theta, x)
    frames = tangent_frame(jet.gradient / jet.gradient.norm(dim=1, keepdim=True))

    def nested(theta: Tensor, point: Tensor, frame: Tensor) -> Tensor:
        def f(x: Tensor) -> Tensor:
            return network.value(theta, x[None])[0]

        return FORMULAS[residual.name](grad(f)(point), jacrev(grad(f))(point), frame)

    expected = vmap(jacrev(nested), in_dims=(None, 0, 0))(theta, x, frames)
    linear = residual(jet.value, jet.gradient, jet.hessian)
    assert linear.by_gradient is not None
    assert linear.by_hessian is not None
    for column in range(linear.residual.shape[1]):
        layers = jet.rows(None, linear.by_gradient[:, column], linear.by_hessian[:, column])
        found = torch.cat([_written(layer) for layer in layers], 1)
        scale = float(expected.abs().max()) + 1.0
        torch.testing.assert_close(found, expected[:, column], rtol=1e-8, atol=1e-10 * scale)


def _written(layer: LayerRows) -> Tensor:
    block = layer.left.new_empty(len(layer.left), layer.size)
    layer.write(block)
    return block


@few
@seeds
def test_the_strains_loss_has_the_gradient_of_its_invariant(seed: int) -> None:
    """Whatever the frame: sum of squares and J^T r are those of |S|^2 / 2."""
    generator = torch.Generator().manual_seed(seed)
    gradient = torch.randn(4, 3, generator=generator, dtype=F64)
    hessian = torch.randn(4, 3, 3, generator=generator, dtype=F64)
    hessian = hessian + hessian.mT
    linear = surface_strain(torch.zeros(4, dtype=F64), gradient, hessian)
    energy = lambda g, H: principal(g, H)[1] / 2  # noqa: E731
    torch.testing.assert_close(linear.residual.square().sum(1) / 2, vmap(energy)(gradient, hessian))
    by_gradient, by_hessian = vmap(grad(energy, argnums=(0, 1)))(gradient, hessian)
    assert linear.by_gradient is not None
    assert linear.by_hessian is not None
    torch.testing.assert_close(torch.einsum("nm,nmi->ni", linear.residual, linear.by_gradient), by_gradient)
    found = torch.einsum("nm,nmij->nij", linear.residual, linear.by_hessian)
    torch.testing.assert_close(found, (by_hessian + by_hessian.mT) / 2)


def test_clipping_caps_the_loss_and_lets_go() -> None:
    radii = torch.tensor([0.1, 1.0, 10.0], dtype=F64)
    x = radii[:, None] * torch.tensor([0.0, 0.6, 0.8], dtype=F64)
    gradient = x / radii[:, None]
    hessian = (torch.eye(3, dtype=F64) - gradient[:, :, None] * gradient[:, None, :]) / radii[:, None, None]
    linear = clipped_strain(50.0)(torch.zeros(3, dtype=F64), gradient, hessian)
    torch.testing.assert_close(linear.residual.square().sum(1), torch.tensor([50.0, 2.0, 0.02], dtype=F64))
    assert linear.by_gradient is not None
    assert linear.by_hessian is not None
    assert float(linear.by_hessian[0].abs().max()) == 0.0
    assert float(linear.by_gradient[0].abs().max()) == 0.0
    smooth = surface_strain(torch.zeros(3, dtype=F64), gradient, hessian)
    assert torch.equal(linear.by_hessian[1:], smooth.by_hessian[1:])
    assert "50" in clipped_strain(50.0).name
    own = clipped_strain(50.0)(
        torch.zeros(3, dtype=F64), gradient, hessian, torch.tensor([300.0, 1.0, 0.01], dtype=F64)
    )
    torch.testing.assert_close(own.residual.square().sum(1), torch.tensor([200.0, 1.0, 0.01], dtype=F64))


@pytest.mark.parametrize("dtype", [torch.float32, F64])
@each_residual
def test_critical_points_are_finite_and_precision_is_kept(residual: SecondOrder, dtype: torch.dtype) -> None:
    linear = residual(torch.zeros(2, dtype=dtype), torch.zeros(2, 3, dtype=dtype), torch.zeros(2, 3, 3, dtype=dtype))
    for part in (linear.residual, linear.by_gradient, linear.by_hessian):
        assert part is not None
        assert part.dtype == dtype
        assert bool(part.isfinite().all())


def test_a_curvature_may_be_prescribed() -> None:
    value, gradient, hessian = at(sphere, [0.3, 0.4, 0.0])
    assert abs(float(mean_curvature(value, gradient, hessian, torch.tensor([4.0], dtype=F64)).residual)) < 1e-12
    assert abs(float(gauss_curvature(value, gradient, hessian, torch.tensor([4.0], dtype=F64)).residual)) < 1e-12


@few
@seeds
def test_a_formula_becomes_the_closed_form(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    value = torch.randn(5, generator=generator, dtype=F64)
    gradient = torch.randn(5, 3, generator=generator, dtype=F64)
    hessian = torch.randn(5, 3, 3, generator=generator, dtype=F64)
    hessian = hessian + hessian.mT
    made = from_formula("div n", lambda f, g, H: 0 * f + principal(g, H)[0][None])
    assert not made.tangential
    assert from_formula("div n", lambda f, g, H: 0 * f + principal(g, H)[0][None], tangential=True).tangential
    found, expected = made(value, gradient, hessian), mean_curvature(value, gradient, hessian)
    torch.testing.assert_close(found.residual, expected.residual)
    torch.testing.assert_close(found.by_gradient, expected.by_gradient)
    torch.testing.assert_close(found.by_hessian, expected.by_hessian)


@few
@seeds
def test_frames_are_orthonormal_and_tangent(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    normals = torch.randn(20, 3, generator=generator, dtype=F64)
    normals = torch.cat(
        [normals / normals.norm(dim=1, keepdim=True), torch.eye(3, dtype=F64), -torch.eye(3, dtype=F64)]
    )
    frames = tangent_frame(normals)
    torch.testing.assert_close(frames.mT @ frames, torch.eye(2, dtype=F64).expand(len(normals), 2, 2))
    torch.testing.assert_close(normals[:, None, :] @ frames, torch.zeros(len(normals), 1, 2, dtype=F64))
