"""Fully connected networks of any activation, with second derivatives in closed form.

With a_0 = x, each hidden layer takes z_l = W_l a_{l-1} + b_l to its units' values a_l, and f = W a_L + b. A unit of q
numbers (two for a wavelet) has q rows in W_l: first those of all units' first numbers, then those of the second ones.

The networks of the paper's shape-learning problems are ``Network((32, 32), TANH)`` and ``Network((32, 32), WAVELET)``.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gnrecon.field.activation import TANH, Activation, parted
from gnrecon.field.curved_jet import CurvedJet
from gnrecon.field.layout import Layout


@dataclass(frozen=True)
class Network:
    """A network from space to one value.

    Parameters
    ----------
    widths : tuple of int
        Hidden units of each layer.
    activation : Activation
    frequencies : tuple of float
        Factors on a unit's numbers in the first layer's start, such as (omega_0, s_0) of a wavelet: how much detail the
        network begins with. One for each number of a unit.
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
        """Return what all derivatives at points x, of shape (N, 3), are made from."""
        return CurvedJet.of(self.layout.layers(theta), self.activation, x)
