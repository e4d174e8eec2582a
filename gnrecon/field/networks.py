"""Sine networks (SIREN) and their first derivatives in closed form.

With a_0 = x, each hidden layer takes z_l = W_l a_{l-1} + b_l to a_l = sin z_l, and f = W a_L + b. The usual factor
omega_0 is not a separate number here: it is part of the weights, so Gauss-Newton can change it.

The adjoints d_l = df/dz_l run backwards from d = 1: d_l = cos z_l o (W_{l+1}^T d_{l+1}), and grad f = W_1^T d_1.

Source: Sitzmann et al., Implicit Neural Representations with Periodic Activation Functions (2020); the paper's
networks for shape reconstruction are ``Siren((32, 32, 32))``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from gnrecon.field.jacobian_rows import CurvedJet, Jet
from gnrecon.field.layers import TANH, Activation, Layout, parted
from gnrecon.field.random_features import Stencil
from gnrecon.runtime.matrix_product import matmul


@dataclass(frozen=True)
class Siren:
    """A sine network from space to one value, of any depth and width.

    Parameters
    ----------
    widths : tuple of int
        Sizes of the hidden layers.
    """

    widths: tuple[int, ...]

    @property
    def layout(self) -> Layout:
        """Where each layer lies in theta."""
        return Layout((3, *self.widths, 1))

    def initial(self, generator: torch.Generator, dtype: torch.dtype = torch.float64) -> Tensor:
        """Return smooth starting parameters, of shape (p,): uniform within 1/sqrt(fan-in), as the paper starts."""
        return self.layout.uniform(generator, dtype)

    def value(self, theta: Tensor, x: Tensor) -> Tensor:
        """Return f, of shape (N,), at points x, of shape (N, 3)."""
        *hidden, (weights, bias) = self.layout.layers(theta)
        activation = x
        for layer_weights, layer_bias in hidden:
            activation = matmul(activation, layer_weights.T).add_(layer_bias).sin_()
        return (activation @ weights[0]).add_(bias)

    def around(self, theta: Tensor, offsets: Tensor) -> Callable[[Tensor], Tensor]:
        """Return the function that gives f, of shape (N, K), at K offsets from centres of shape (N, 3).

        Parameters
        ----------
        theta : of shape (p,)
        offsets : of shape (K, 3)
        """
        layers = self.layout.layers(theta)
        if len(layers) > 2:
            return lambda x: self.value(theta, (x[:, None] + offsets).reshape(-1, 3)).reshape(len(x), -1)
        (weights, bias), (outer, constant) = layers
        stencil = Stencil.of(weights, offsets)
        return lambda x: stencil.sums(torch.addmm(bias, x, weights.T), outer[0]).add_(constant)

    def value_and_gradient(self, theta: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return f, of shape (N,), and its gradient in x, of shape (N, 3), at points x, of shape (N, 3)."""
        jet = self.jet(theta, x)
        return jet.value, jet.gradient

    def jet(self, theta: Tensor, x: Tensor) -> Jet:
        """Return activations and adjoints at points x, of shape (N, 3), from which all derivatives follow."""
        layers = self.layout.layers(theta)
        activations, slopes = [x], []
        for weights, bias in layers[:-1]:
            z = matmul(activations[-1], weights.T).add_(bias)
            slopes.append(z.cos())
            activations.append(z.sin_())
        value = (activations[-1] @ layers[-1][0][0]).add_(layers[-1][1])
        adjoints = [torch.ones_like(value)[:, None]]
        for slope, (weights, _) in zip(reversed(slopes), reversed(layers[1:]), strict=True):
            adjoints.insert(0, matmul(adjoints[0], weights).mul_(slope))
        return Jet(layers, activations, slopes, adjoints, value, adjoints[0] @ layers[0][0])


# Fully connected networks of any activation, with second derivatives in closed form.
#
# With a_0 = x, each hidden layer takes z_l = W_l a_{l-1} + b_l to its units' values a_l, and f = W a_L + b. A unit of q
# numbers (two for a wavelet) has q rows in W_l: first those of all units' first numbers, then those of the second.
#
# The networks of the paper's shape-learning problems are ``Network((32, 32), TANH)`` and ``Network((32, 32),
# WAVELET)``.


@dataclass(frozen=True)
class Network:
    """A network from space to one value.

    Parameters
    ----------
    widths : tuple of int
        Hidden units of each layer.
    activation : Activation
    frequencies : tuple of float
        Factors of the first layer's initial weights, one for each input of a unit, such as (omega_0, s_0) of a wavelet.
        They set the scale of the initial detail.
    """

    widths: tuple[int, ...]
    activation: Activation = TANH
    frequencies: tuple[float, ...] = (1.0,)

    def __post_init__(self) -> None:
        """Refuse frequencies that do not fit the activation."""
        if len(self.frequencies) != self.activation.inputs:
            raise ValueError(f"A {self.activation.name} unit has {self.activation.inputs} frequencies.")

    @property
    def layout(self) -> Layout:
        """Where each layer lies in theta."""
        return Layout((3, *self.widths, 1), self.activation.inputs)

    def initial(self, generator: torch.Generator, dtype: torch.dtype = torch.float64) -> Tensor:
        """Return starting parameters, of shape (p,): uniform within 1/sqrt(fan-in), times the frequencies at first."""
        theta = self.layout.uniform(generator, dtype)
        factors = torch.tensor(self.frequencies, dtype=dtype).repeat_interleave(self.widths[0])
        weights, bias = self.layout.layers(theta)[0]  # views of theta
        weights *= factors[:, None]
        bias *= factors
        return theta

    def value(self, theta: Tensor, x: Tensor) -> Tensor:
        """Return f, of shape (N,), at points x, of shape (N, 3)."""
        *hidden, (weights, bias) = self.layout.layers(theta)
        activation = x
        for layer_weights, layer_bias in hidden:
            z = torch.addmm(layer_bias, activation, layer_weights.T)
            activation = self.activation(parted(z, self.activation.inputs))
        return (activation @ weights[0]) + bias

    def value_and_gradient(self, theta: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return f, of shape (N,), and its gradient in x, of shape (N, 3), at points x, of shape (N, 3)."""
        jet = CurvedJet.of(self.layout.layers(theta), self.activation, x, order=1)
        return jet.value, jet.gradient

    def curved_jet(self, theta: Tensor, x: Tensor) -> CurvedJet:
        """Return the network's derivatives at points x, of shape (N, 3)."""
        return CurvedJet.of(self.layout.layers(theta), self.activation, x)
