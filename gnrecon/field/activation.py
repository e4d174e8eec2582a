"""Activations of a network's hidden units with their derivatives up to the third.

A unit takes q numbers z (one, or two for a wavelet) to one number. With second derivatives of a network in space, the
Jacobian by its parameters needs the third derivatives of its units, and no more.

    sine      sin z                        Sitzmann et al., Implicit neural representations with periodic activation
                                           functions (2020)
    tanh      tanh z                       the paper's minimal and developable surfaces
    wavelet   cos z_1 exp(-z_2^2)          the real Gabor wavelet of Saragadam et al., WIRE: wavelet implicit neural
                                           representations (2023); the paper's bracket

The usual factors omega_0 and s_0 are no separate numbers here: they are part of the weights, which begin larger.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations_with_replacement

import torch
from torch import Tensor

Index = tuple[int, ...]
"""By which of a unit's numbers it is differentiated, ascending: () not at all, (0, 0) twice by the first one."""


@dataclass(frozen=True)
class Activation:
    """What a hidden unit does.

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
"""All of them by their names."""
