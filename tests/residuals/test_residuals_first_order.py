"""Linearised residuals against automatic differentiation of formulas written out here, and on exact distances."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.func import jacrev, vmap

from gnrecon import residuals
from gnrecon.residuals import Residual

Formula = Callable[[Tensor, Tensor, Tensor], Tensor]

# Residuals, of shape (m,), of one point's value (), gradient (3,) and target () or (3,).
FORMULAS: dict[str, Formula] = {
    "interface": lambda f, _g, _t: f[None],
    "design_region": lambda f, _g, _t: torch.minimum(f, torch.zeros_like(f))[None],
    "free_space": lambda f, _g, t: torch.minimum(torch.sign(t) * (f - t), torch.zeros_like(f))[None],
    "signed_distance": lambda f, _g, t: (f - t)[None],
    "value_range": lambda f, _g, t: (f - f.clamp(t[0], t[1]))[None],
    "normal_vector": lambda _f, g, t: g - t,
    "normal_projection": lambda _f, g, t: (g @ t)[None] - 1,
    "normal_cosine": lambda _f, g, t: (g @ t)[None] / g.norm() - 1,
    "eikonal": lambda _f, g, _t: g.norm()[None] - 1,
}

each_residual = pytest.mark.parametrize("name", FORMULAS)
seeds = given(seed=st.integers(0, 2**32 - 1))
few = settings(max_examples=10, deadline=None)


def by_name(name: str) -> Residual:
    function: Residual = getattr(residuals, name)
    return function


def targets(name: str, generator: torch.Generator, count: int) -> Tensor | None:
    if name in ("interface", "design_region", "eikonal"):
        return None
    if name in ("signed_distance", "free_space"):
        return torch.randn(count, generator=generator, dtype=torch.float64)
    if name == "value_range":
        return torch.randn(count, 2, generator=generator, dtype=torch.float64).sort(dim=1).values
    normals = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    return normals / normals.norm(dim=1, keepdim=True)


def test_a_design_region_may_ask_for_more_than_zero() -> None:
    value = torch.tensor([-0.2, 0.1, 0.4], dtype=torch.float64)
    least = torch.tensor([0.0, 0.3, 0.3], dtype=torch.float64)
    linear = residuals.design_region(value, torch.zeros(3, 3, dtype=torch.float64), least)
    torch.testing.assert_close(linear.residual[:, 0], torch.tensor([-0.2, -0.2, 0.0], dtype=torch.float64))
    assert linear.by_value is not None
    assert linear.by_value[:, 0].tolist() == [1.0, 1.0, 0.0]


def test_a_range_has_two_ends() -> None:
    value = torch.tensor([-0.3, -0.1, 0.2, 0.5], dtype=torch.float64)
    ends = torch.tensor([[-0.2, 0.3]], dtype=torch.float64).expand(4, 2)
    linear = residuals.value_range(value, torch.zeros(4, 3, dtype=torch.float64), ends)
    torch.testing.assert_close(linear.residual[:, 0], torch.tensor([-0.1, 0.0, 0.0, 0.2], dtype=torch.float64))
    assert linear.by_value is not None
    assert linear.by_value[:, 0].tolist() == [1.0, 0.0, 0.0, 1.0]
    assert linear.by_gradient is None


def test_free_space_has_two_sides() -> None:
    value = torch.tensor([0.3, 0.1, -0.1, -0.1, 0.2], dtype=torch.float64)
    least = torch.tensor([0.2, 0.2, 0.2, -0.2, -0.2], dtype=torch.float64)
    linear = residuals.free_space(value, torch.zeros(5, 3, dtype=torch.float64), least)
    torch.testing.assert_close(linear.residual[:, 0], torch.tensor([0, -0.1, -0.3, -0.1, -0.4], dtype=torch.float64))
    assert linear.by_value is not None
    assert linear.by_value[:, 0].tolist() == [0.0, 1.0, 1.0, -1.0, -1.0]


def test_every_residual_is_tested() -> None:
    # Those with second derivatives are in test_residuals_second_order.
    second = {name for name in residuals.__all__ if isinstance(getattr(residuals, name), residuals.SecondOrder)}
    makers = {"Linearised", "Residual", "SecondOrder", "clipped_strain", "from_formula", "named", "tangents"}
    assert set(residuals.__all__) - makers - second == set(FORMULAS)


@each_residual
@few
@seeds
def test_derivatives_agree_with_autodiff(name: str, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    value = torch.randn(9, generator=generator, dtype=torch.float64)
    gradient = torch.randn(9, 3, generator=generator, dtype=torch.float64)
    target = targets(name, generator, 9)
    linear = by_name(name)(value, gradient, target)
    third = value if target is None else target
    formula = FORMULAS[name]
    torch.testing.assert_close(linear.residual, vmap(formula)(value, gradient, third))
    for found, argument in ((linear.by_value, 0), (linear.by_gradient, 1)):
        oracle = vmap(jacrev(formula, argnums=argument))(value, gradient, third)
        # None stands for a derivative that vanishes everywhere.
        torch.testing.assert_close(torch.zeros_like(oracle) if found is None else found, oracle)
    assert linear.by_value is not None or linear.by_gradient is not None


@each_residual
@few
@seeds
def test_an_exact_distance_has_no_residual(name: str, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    center = torch.randn(3, generator=generator, dtype=torch.float64)
    radius = 0.2 + float(torch.rand(1, generator=generator))
    normals = torch.randn(20, 3, generator=generator, dtype=torch.float64)
    normals = normals / normals.norm(dim=1, keepdim=True)
    distance = torch.zeros(20, dtype=torch.float64)
    if name in ("signed_distance", "free_space", "value_range", "eikonal"):
        distance = torch.rand(20, generator=generator, dtype=torch.float64) - 0.2
    x = (center + (radius + distance)[:, None] * normals).requires_grad_()
    value = (x - center).norm(dim=1) - radius
    (gradient,) = torch.autograd.grad(value.sum(), x)
    known = dict.fromkeys(("interface", "design_region", "eikonal"), None) | dict.fromkeys(
        ("signed_distance", "free_space"), distance
    )
    known["value_range"] = torch.stack([distance - 0.05, distance + 0.05], dim=1)
    target = known.get(name, normals)
    residual = by_name(name)(value.detach(), gradient, target).residual
    torch.testing.assert_close(residual, torch.zeros_like(residual), rtol=0, atol=1e-12)
    # A field that keeps away from the surface may do so by more, on either side.
    inward = -0.3 if name == "design_region" else -0.1 * distance.sign() if name == "free_space" else 0.1
    moved = by_name(name)(value.detach() + inward, 1.2 * gradient.roll(1, dims=1), target).residual
    assert float(moved.abs().max()) > 0.05


@each_residual
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_critical_points_are_finite_and_precision_is_kept(name: str, dtype: torch.dtype) -> None:
    target = targets(name, torch.Generator().manual_seed(0), 4)
    target = None if target is None else target.to(dtype)
    linear = by_name(name)(torch.zeros(4, dtype=dtype), torch.zeros(4, 3, dtype=dtype), target)
    for part in (linear.residual, linear.by_value, linear.by_gradient):
        if part is not None:
            assert part.dtype == dtype
            assert bool(part.isfinite().all())


@pytest.mark.parametrize("name", ["normal_vector", "normal_projection", "normal_cosine"])
def test_normals_have_the_right_side(name: str) -> None:
    normals = torch.eye(3, dtype=torch.float64)
    good = by_name(name)(torch.zeros(3, dtype=torch.float64), normals, normals).residual
    flipped = by_name(name)(torch.zeros(3, dtype=torch.float64), -normals, normals).residual
    assert float(good.abs().max()) == 0.0
    torch.testing.assert_close(flipped.norm(dim=1), torch.full((3,), 2.0, dtype=torch.float64))


def test_the_cosine_ignores_the_gradients_length() -> None:
    normals = torch.eye(3, dtype=torch.float64)
    linear = residuals.normal_cosine(torch.zeros(3, dtype=torch.float64), 7.0 * normals, normals)
    assert float(linear.residual.abs().max()) == 0.0
