"""Activations of a network's hidden units with derivatives up to the third, and the layout of its parameters.

A unit maps q numbers z (one, or two for a wavelet) to one number. The Jacobian by the parameters of a network's second
derivatives in space needs the third derivatives of its units.

    sine      sin z                        Sitzmann et al., Implicit neural representations with periodic activation
                                           functions (2020)
    tanh      tanh z                       the paper's minimal and developable surfaces
    wavelet   cos z_1 exp(-z_2^2)          the real Gabor wavelet of Saragadam et al., WIRE: wavelet implicit neural
                                           representations (2023); the paper's bracket

The usual factors omega_0 and s_0 are not separate numbers here: they are part of the initial weights.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement, pairwise

import torch
from torch import Tensor

Index = tuple[int, ...]
"""The inputs of a unit by which it is differentiated, ascending: () for the value, (0, 0) twice by the first one."""


@dataclass(frozen=True)
class Activation:
    """The function of a hidden unit.

    Parameters
    ----------
    name : str
    inputs : int
        Numbers q that a unit takes; z has shape (N, q, units).
    derivatives : function of z and the highest order, giving each derivative, of shape (N, units), by its index
    """

    name: str
    inputs: int
    derivatives: Callable[[Tensor, int], dict[Index, Tensor]]

    def __call__(self, z: Tensor) -> Tensor:
        """Return the units' values, of shape (N, units), at z, of shape (N, q, units)."""
        return self.derivatives(z, 0)[()]


def parted(z: Tensor, inputs: int) -> Tensor:
    """Return numbers of shape (..., q units) as (..., q, units)."""
    return z.view(*z.shape[:-1], inputs, z.shape[-1] // inputs)


def indices(inputs: int, order: int) -> list[Index]:
    """Return the indices of all derivatives of one order, each once."""
    return list(combinations_with_replacement(range(inputs), order))


def _sine(z: Tensor, order: int) -> dict[Index, Tensor]:
    sine = z[:, 0].sin()
    if not order:
        return {(): sine}
    cosine = z[:, 0].cos()
    return dict(zip(_alone(order), (sine, cosine, -sine, -cosine), strict=False))


def _tanh(z: Tensor, order: int) -> dict[Index, Tensor]:
    t = z[:, 0].tanh()
    found: dict[Index, Tensor] = {(): t}
    if order:
        found[(0,)] = slope = 1 - t * t
    if order > 1:
        found[(0, 0)] = -2 * t * slope
    if order > 2:
        found[(0, 0, 0)] = slope * (6 * t * t - 2)
    return found


def _wavelet(z: Tensor, order: int) -> dict[Index, Tensor]:
    """Products of the derivatives of the two factors."""
    phase, distance = z[:, 0], z[:, 1]
    bell = torch.exp(-distance * distance)
    sine, cosine = phase.sin(), phase.cos()
    waves = (cosine, -sine, -cosine, sine)
    square = distance * distance
    bells = (
        bell,
        -2 * distance * bell,
        (4 * square - 2) * bell,
        (12 - 8 * square) * distance * bell,
    )
    every = [index for level in range(order + 1) for index in indices(2, level)]
    return {index: waves[index.count(0)] * bells[index.count(1)] for index in every}


def _alone(order: int) -> list[Index]:
    return [(0,) * level for level in range(order + 1)]


SINE = Activation("sine", 1, _sine)

TANH = Activation("tanh", 1, _tanh)

WAVELET = Activation("wavelet", 2, _wavelet)

ACTIVATIONS = {one.name: one for one in (SINE, TANH, WAVELET)}
"""The activations by name."""


@dataclass(frozen=True)
class Layout:
    """Layer sizes of a fully connected network, input and output included, e.g. ``(3, 32, 32, 1)``.

    The parameter vector theta holds, layer by layer, the weights W (out, in) row by row and then the biases b (out).
    Hidden units that take several numbers have as many rows in their layer.
    """

    sizes: tuple[int, ...]
    unit_inputs: int = 1

    @property
    def shapes(self) -> tuple[tuple[int, int], ...]:
        """(out, in) of each layer."""
        *hidden, (into, out) = pairwise(self.sizes)
        return (*((self.unit_inputs * units, before) for before, units in hidden), (out, into))

    @property
    def count(self) -> int:
        """Number of parameters p."""
        return sum(out * (into + 1) for out, into in self.shapes)

    @property
    def offsets(self) -> tuple[int, ...]:
        """Index of the first parameter of each layer in theta."""
        starts = [0]
        for out, into in self.shapes[:-1]:
            starts.append(starts[-1] + out * (into + 1))
        return tuple(starts)

    def columns(self, units: Sequence[Tensor | None]) -> Tensor:
        """Return the places in theta of the parameters that lead into the given units, layer by layer.

        Parameters
        ----------
        units : for each layer the indices of its output units, of shape (k,); None means all of them
        """
        columns = []
        for (out, into), start, chosen in zip(self.shapes, self.offsets, units, strict=True):
            rows = torch.arange(out) if chosen is None else chosen.cpu()
            columns.append((start + rows[:, None] * into + torch.arange(into)).flatten())
            columns.append(start + out * into + rows)
        return torch.cat(columns)

    def layers(self, theta: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Return views (W of shape (out, in), b of shape (out,)) of theta, of shape (p,)."""
        views = []
        for (out, into), start in zip(self.shapes, self.offsets, strict=True):
            split = start + out * into
            views.append((theta[start:split].view(out, into), theta[split : split + out]))
        return views

    def uniform(self, generator: torch.Generator, dtype: torch.dtype = torch.float64) -> Tensor:
        """Return theta, of shape (p,), with weights and biases drawn uniformly within 1/sqrt(fan-in) of zero."""
        layers = []
        for out, into in self.shapes:
            bound = 1.0 / math.sqrt(into)
            drawn = torch.rand(out, into + 1, generator=generator, dtype=dtype) * (2 * bound) - bound
            layers.append((drawn[:, :-1], drawn[:, -1]))
        return self.flatten(layers)

    def flatten(self, layers: list[tuple[Tensor, Tensor]]) -> Tensor:
        """Return theta, of shape (p,), from the layers' weights and biases."""
        return torch.cat([part.reshape(-1) for layer in layers for part in layer])
