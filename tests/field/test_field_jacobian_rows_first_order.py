"""Values, gradients and Jacobian rows in closed form against nested automatic differentiation in float64."""

from __future__ import annotations

import pytest
import torch
from dense_rows import dense
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.func import grad, jacrev, vmap

from gnrecon.field import Siren

DEPTHS = [(7,), (1,), (5, 8), (8, 5), (6, 4, 7), (3, 9, 2)]
EXACT = {"rtol": 1e-9, "atol": 1e-9}

each_field = pytest.mark.parametrize("widths", DEPTHS, ids=str)
seeds = given(seed=st.integers(0, 2**32 - 1))
few = settings(max_examples=5, deadline=None)


def plain_value(theta: Tensor, widths: tuple[int, ...], x: Tensor) -> Tensor:
    """The network at one point of shape (3,), written out from the definition of theta's order."""
    place, activation = 0, x
    for level, out in enumerate((*widths, 1)):
        into = len(activation)
        weights = torch.stack([theta[place + row * into : place + (row + 1) * into] for row in range(out)])
        place += out * into
        z = weights @ activation + theta[place : place + out]
        place += out
        activation = torch.sin(z) if level < len(widths) else z
    return activation[0]


def draw(seed: int, widths: tuple[int, ...], count: int = 6) -> tuple[Siren, Tensor, Tensor, torch.Generator]:
    generator = torch.Generator().manual_seed(seed)
    field = Siren(widths)
    theta = torch.randn(field.layout.count, generator=generator, dtype=torch.float64)
    return field, theta, torch.randn(count, 3, generator=generator, dtype=torch.float64), generator


def autodiff_rows(widths: tuple[int, ...], theta: Tensor, x: Tensor, by_value: Tensor, by_gradient: Tensor) -> Tensor:
    """Differentiate c f + v . grad f by theta, point by point."""

    def combined(theta: Tensor, x: Tensor, c: Tensor, v: Tensor) -> Tensor:
        return c * plain_value(theta, widths, x) + v @ grad(plain_value, argnums=2)(theta, widths, x)

    return vmap(jacrev(combined), in_dims=(None, 0, 0, 0))(theta, x, by_value, by_gradient)


@each_field
@few
@seeds
def test_value_and_gradient(widths: tuple[int, ...], seed: int) -> None:
    field, theta, x, _ = draw(seed, widths)
    value = torch.stack([plain_value(theta, widths, point) for point in x])
    gradient = torch.stack([grad(plain_value, argnums=2)(theta, widths, point) for point in x])
    jet = field.jet(theta, x)
    torch.testing.assert_close(field.value(theta, x), value, **EXACT)
    torch.testing.assert_close(jet.value, value, **EXACT)
    torch.testing.assert_close(jet.gradient, gradient, **EXACT)
    torch.testing.assert_close(field.value_and_gradient(theta, x), (value, gradient), **EXACT)


@each_field
@few
@seeds
def test_features_are_what_the_last_layer_sees(widths: tuple[int, ...], seed: int) -> None:
    field, theta, x, _ = draw(seed, widths)
    weights, bias = field.layout.layers(theta)[-1]
    features = field.jet(theta, x).activations[-1]
    assert features.shape == (len(x), widths[-1])
    torch.testing.assert_close((features @ weights.T + bias)[:, 0], field.value(theta, x), **EXACT)


@each_field
@pytest.mark.parametrize("kind", ["value", "direction", "gradient", "mixed"])
@few
@seeds
def test_jacobian_rows(widths: tuple[int, ...], kind: str, seed: int) -> None:
    field, theta, x, generator = draw(seed, widths)
    c = torch.randn(len(x), generator=generator, dtype=torch.float64)
    jet = field.jet(theta, x)
    # An eikonal row differentiates along the field's own gradient, which is held fixed.
    v = jet.gradient if kind == "gradient" else torch.randn(len(x), 3, generator=generator, dtype=torch.float64)
    by_value = None if kind in ("direction", "gradient") else c
    by_gradient = None if kind == "value" else v
    oracle = autodiff_rows(
        widths,
        theta,
        x,
        torch.zeros_like(c) if by_value is None else c,
        torch.zeros_like(v) if by_gradient is None else v,
    )
    torch.testing.assert_close(dense(jet.rows(by_value, by_gradient)), oracle, **EXACT)


@few
@seeds
def test_rows_leave_the_jet_as_it_was(seed: int) -> None:
    field, theta, x, generator = draw(seed, (6, 5))
    jet = field.jet(theta, x)
    v = torch.randn(len(x), 3, generator=generator, dtype=torch.float64)
    first = dense(jet.rows(jet.value, v))
    jet.rows(None, 2 * v)
    jet.rows(3 * jet.value, None)
    assert torch.equal(dense(jet.rows(jet.value, v)), first)
    assert torch.equal(jet.value, field.jet(theta, x).value)


@pytest.mark.parametrize("widths", [(7,), (6, 5, 4)], ids=str)
@few
@seeds
def test_columns_of_some_units(widths: tuple[int, ...], seed: int) -> None:
    field, theta, x, generator = draw(seed, widths)
    v = torch.randn(len(x), 3, generator=generator, dtype=torch.float64)
    layers = field.jet(theta, x).rows(v[:, 0], v)
    units = [torch.randperm(out, generator=generator)[: (out + 1) // 2] for out, _ in field.layout.shapes]
    some = dense([layer.into(chosen) for layer, chosen in zip(layers, units, strict=True)])
    assert torch.equal(some, dense(layers)[:, field.layout.columns(units)])
    none = torch.zeros(0, dtype=torch.long)
    last = dense([*(layer.into(none) for layer in layers[:-1]), layers[-1]])
    assert torch.equal(last, dense(layers)[:, field.layout.columns([*(none for _ in widths), None])])


def test_rows_may_be_written_into_part_of_a_wider_block() -> None:
    field, theta, x, _ = draw(5, (4, 6))
    layers = field.jet(theta, x).rows(x[:, 0], x)
    block = torch.full((len(x), field.layout.count + 3), torch.nan, dtype=torch.float64)
    start = 0
    for layer in layers:
        layer.write(block[:, start : start + layer.size])
        start += layer.size
    assert torch.equal(block[:, :start], dense(layers))
    assert bool(block[:, start:].isnan().all())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("widths", [(7,), (6, 5)], ids=str)
def test_precision_is_kept(widths: tuple[int, ...], dtype: torch.dtype) -> None:
    field, theta, x, _ = draw(11, widths)
    theta, x = theta.to(dtype), x.to(dtype)
    jet = field.jet(theta, x)
    rows = dense(jet.rows(x[:, 0], x))
    for tensor in (field.value(theta, x), field.jet(theta, x).activations[-1], jet.value, jet.gradient, rows):
        assert tensor.dtype == dtype
    oracle = autodiff_rows(widths, theta.double(), x.double(), x[:, 0].double(), x.double())
    torch.testing.assert_close(
        rows.double(), oracle, rtol=0, atol=200 * torch.finfo(dtype).eps * float(oracle.abs().max())
    )


def test_no_points_are_allowed() -> None:
    field, theta, x, _ = draw(1, (4, 3))
    assert field.value(theta, x[:0]).shape == (0,)
    value, gradient = field.value_and_gradient(theta, x[:0])
    assert value.shape == (0,)
    assert gradient.shape == (0, 3)


@each_field
@few
@seeds
def test_second_derivatives_in_space(widths: tuple[int, ...], seed: int) -> None:
    field, theta, x, _ = draw(seed, widths)
    expected = vmap(jacrev(grad(plain_value, argnums=2), argnums=2), in_dims=(None, None, 0))(theta, widths, x)
    found = field.jet(theta, x).hessian()
    torch.testing.assert_close(found, expected, **EXACT)
    assert torch.equal(found, found.mT)
