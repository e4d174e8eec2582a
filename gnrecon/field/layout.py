"""Where each layer's weights lie in the flat parameter vector."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor


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
        """Where each layer begins in theta."""
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
