"""Networks with second derivatives: values, Hessians and Jacobian rows against nested automatic differentiation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from dense_rows import dense
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.func import grad, jacrev, vmap

from gnrecon.field import ACTIVATIONS, SINE, Network, Siren
from gnrecon.field.layers import indices

DEPTHS = [(5,), (1,), (4, 3), (3, 5, 4)]
EXACT = {"rtol": 1e-9, "atol": 1e-9}

each_activation = pytest.mark.parametrize("name", ACTIVATIONS)
each_depth = pytest.mark.parametrize("widths", DEPTHS, ids=str)
seeds = given(seed=st.integers(0, 2**32 - 1))
few = settings(max_examples=3, deadline=None)

# The units' values written out once more, at q numbers of shape (q, units).
PLAIN = {
    "sine": lambda z: torch.sin(z[0]),
    "tanh": lambda z: torch.tanh(z[0]),
    "wavelet": lambda z: torch.cos(z[0]) * torch.exp(-(z[1] ** 2)),
}


def plain_value(theta: Tensor, name: str, widths: tuple[int, ...], x: Tensor) -> Tensor:
    """The network at one point of shape (3,), from the definition of theta's order."""
    parts, place, activation = ACTIVATIONS[name].inputs, 0, x
    for level, units in enumerate((*widths, 1)):
        hidden = level < len(widths)
        out, into = units * (parts if hidden else 1), len(activation)
        weights = theta[place : place + out * into].reshape(out, into)
        z = weights @ activation + theta[place + out * into : place + out * (into + 1)]
        place += out * (into + 1)
        activation = PLAIN[name](z.reshape(parts, units)) if hidden else z
    return activation[0]


def draw(seed: int, name: str, widths: tuple[int, ...], count: int = 5) -> tuple[Network, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    kind = ACTIVATIONS[name]
    network = Network(widths, kind, (1.0,) * kind.inputs)
    theta = 0.7 * torch.randn(network.layout.count, generator=generator, dtype=torch.float64)
    return network, theta, torch.randn(count, 3, generator=generator, dtype=torch.float64)


@each_activation
@each_depth
@few
@seeds
def test_value_gradient_and_hessian(name: str, widths: tuple[int, ...], seed: int) -> None:
    network, theta, x = draw(seed, name, widths)
    jet = network.curved_jet(theta, x)
    value = torch.stack([plain_value(theta, name, widths, point) for point in x])
    gradient = torch.stack([grad(plain_value, argnums=3)(theta, name, widths, point) for point in x])
    second = torch.stack([jacrev(grad(plain_value, argnums=3), argnums=3)(theta, name, widths, point) for point in x])
    torch.testing.assert_close(network.value(theta, x), value, **EXACT)
    torch.testing.assert_close(network.value_and_gradient(theta, x), (value, gradient), **EXACT)
    torch.testing.assert_close(jet.value, value, **EXACT)
    torch.testing.assert_close(jet.gradient, gradient, **EXACT)
    torch.testing.assert_close(jet.hessian, second, **EXACT)
    assert torch.equal(jet.hessian, jet.hessian.mT)


@each_activation
@each_depth
@pytest.mark.parametrize("parts", ["value", "gradient", "hessian", "all", "value and hessian"])
@few
@seeds
def test_rows(name: str, widths: tuple[int, ...], parts: str, seed: int) -> None:
    network, theta, x = draw(seed, name, widths)
    generator = torch.Generator().manual_seed(seed + 1)
    c = torch.randn(len(x), generator=generator, dtype=torch.float64)
    v = torch.randn(len(x), 3, generator=generator, dtype=torch.float64)
    M = torch.randn(len(x), 3, 3, generator=generator, dtype=torch.float64)
    M = M + M.mT
    c, v, M = (t * float(which in parts or parts == "all") for t, which in ((c, "value"), (v, "grad"), (M, "hess")))

    def combined(theta: Tensor, x: Tensor, c: Tensor, v: Tensor, M: Tensor) -> Tensor:
        def f(x: Tensor) -> Tensor:
            return plain_value(theta, name, widths, x)

        return c * f(x) + v @ grad(f)(x) + (M * jacrev(grad(f))(x)).sum()

    expected = vmap(jacrev(combined), in_dims=(None, 0, 0, 0, 0))(theta, x, c, v, M)
    given = [t if which in parts or parts == "all" else None for t, which in ((c, "value"), (v, "grad"), (M, "hess"))]
    found = dense(network.curved_jet(theta, x).rows(*given))
    torch.testing.assert_close(found, expected, **EXACT)


def component(function: Callable[[Tensor], Tensor], which: int) -> Callable[[Tensor], Tensor]:
    return lambda z: grad(function)(z)[which]


@each_activation
def test_derivatives_of_units(name: str) -> None:
    kind = ACTIVATIONS[name]
    z = torch.randn(7, kind.inputs, 2, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    found = kind.derivatives(z, 3)
    assert set(found) == {index for order in range(4) for index in indices(kind.inputs, order)}
    for index, values in found.items():

        def along(numbers: Tensor, index: tuple[int, ...] = index) -> Tensor:
            function = lambda z: PLAIN[name](z[:, None])[0]  # noqa: E731
            for which in index:
                function = component(function, which)
            return function(numbers)

        expected = torch.stack([torch.stack([along(z[n, :, u]) for u in range(2)]) for n in range(7)])
        torch.testing.assert_close(values, expected, rtol=1e-12, atol=1e-12)


@few
@seeds
def test_the_sine_network_is_the_siren(seed: int) -> None:
    network, theta, x = draw(seed, "sine", (6, 4))
    siren = Siren((6, 4))
    assert network.layout.shapes == siren.layout.shapes
    torch.testing.assert_close(network.value(theta, x), siren.value(theta, x), **EXACT)
    torch.testing.assert_close(network.curved_jet(theta, x).hessian, siren.jet(theta, x).hessian(), **EXACT)
    v = x.roll(1, 0)
    found = dense(network.curved_jet(theta, x).rows(x[:, 0], v))
    torch.testing.assert_close(found, dense(siren.jet(theta, x).rows(x[:, 0], v)), **EXACT)


def test_several_residuals_share_one_jet() -> None:
    network, theta, x = draw(5, "wavelet", (6, 5))
    jet = network.curved_jet(theta, x)
    M = torch.eye(3, dtype=torch.float64).expand(len(x), 3, 3)
    first = dense(jet.rows(None, None, M))
    jet.rows(jet.value, jet.gradient, 2 * M)
    assert torch.equal(dense(jet.rows(None, None, M)), first)


@each_activation
def test_the_start_is_reproducible_and_its_frequencies_scale_the_first_layer(name: str) -> None:
    kind = ACTIVATIONS[name]
    plain = Network((4, 3), kind, (1.0,) * kind.inputs)
    theta = plain.initial(torch.Generator().manual_seed(1))
    assert torch.equal(theta, plain.initial(torch.Generator().manual_seed(1)))
    assert len(theta) == plain.layout.count
    factors = (10.0, 3.0)[: kind.inputs]
    faster = Network((4, 3), kind, factors)
    layers, slow = faster.layout.layers(faster.initial(torch.Generator().manual_seed(1))), plain.layout.layers(theta)
    for part, factor in enumerate(factors):
        rows = slice(4 * part, 4 * part + 4)
        torch.testing.assert_close(layers[0][0][rows], factor * slow[0][0][rows])
    assert torch.equal(layers[1][0], slow[1][0])


def test_frequencies_must_fit_the_activation() -> None:
    with pytest.raises(ValueError, match="2 frequencies"):
        Network((4,), ACTIVATIONS["wavelet"], (1.0,))


def test_no_points_are_allowed() -> None:
    network, theta, x = draw(1, "sine", (4, 3))
    assert SINE is network.activation
    jet = network.curved_jet(theta, x[:0])
    assert jet.hessian.shape == (0, 3, 3)
    assert dense(jet.rows(None, None, jet.hessian)).shape == (0, network.layout.count)


@each_activation
@each_depth
@few
@seeds
def test_two_directions_know_all_but_what_is_across_them_twice(name: str, widths: tuple[int, ...], seed: int) -> None:
    network, theta, x = draw(seed, name, widths)
    generator = torch.Generator().manual_seed(seed + 1)
    turned = torch.linalg.qr(torch.randn(len(x), 3, 3, generator=generator, dtype=torch.float64)).Q
    T, n = turned[:, :, :2], turned[:, :, 2:]
    jet = network.curved_jet(theta, x)
    some = replace(jet, directions=T.permute(2, 0, 1))
    across = n.mT @ jet.hessian @ n
    torch.testing.assert_close(some.hessian, jet.hessian - across * (n @ n.mT), **EXACT)
    M = torch.randn(len(x), 2, 2, generator=generator, dtype=torch.float64)
    M = T @ (M + M.mT) @ T.mT
    v = torch.randn(len(x), 3, generator=generator, dtype=torch.float64)
    torch.testing.assert_close(dense(some.rows(None, v, M)), dense(jet.rows(None, v, M)), **EXACT)
    assert len(some.rows(None, v, M)[0].pairs) == 3, "one outer product fewer"
