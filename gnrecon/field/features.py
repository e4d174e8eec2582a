"""Sine features: a layer of fixed frequencies and phases, of which any number of functions are weighted sums.

    c(x) = sum_j a_j sin(F_j . (x - c_0) / l + p_j)

Frequencies F are drawn for a length of one, so that one draw serves functions of any length l about any centre c_0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

DEGREES_OF_FREEDOM = 12.0
"""Of the features' spectrum, a Student t distribution: the larger, the smoother; 4 is a Matern kernel's."""


@dataclass(frozen=True)
class Features:
    """Frequencies for a length of one, of shape (m, 3), and phases, of shape (m,)."""

    frequencies: Tensor
    phases: Tensor

    @classmethod
    def draw(cls, count: int, rng: np.random.Generator, like: Tensor) -> Features:
        """Draw features; their kernel is smooth, see `DEGREES_OF_FREEDOM`."""
        spread = np.sqrt(rng.chisquare(DEGREES_OF_FREEDOM, count) / DEGREES_OF_FREEDOM)
        frequencies = rng.standard_normal((count, 3)) / spread[:, None]
        phases = rng.uniform(0.0, 2 * np.pi, count)
        return cls(torch.as_tensor(frequencies).to(like), torch.as_tensor(phases).to(like))

    def __len__(self) -> int:
        return len(self.phases)

    def to(self, dtype: torch.dtype) -> Features:
        """Return the same features in another precision."""
        return Features(self.frequencies.to(dtype), self.phases.to(dtype))

    def phase(self, x: Tensor, center: Tensor, length: float) -> Tensor:
        """Return F . (x - center) / length + p, of shape (N, m), in the features' precision."""
        # Relative to the centre first: in single precision nothing is lost then.
        local = ((x - center) / length).to(self.frequencies)
        return torch.addmm(self.phases, local, self.frequencies.T)

    def sums(self, amplitudes: Tensor, x: Tensor, center: Tensor, length: float, order: int) -> list[Tensor]:
        """Return c at x, of shape (N, 3), and its derivatives in space up to an order of at most two.

        Returns
        -------
        list of Tensor
            Of shapes (N,), (N, 3) and (N, 3, 3).
        """
        # The amplitudes go with the frequencies, of which there are few, and not with a matrix of a column a feature.
        z = self.phase(x, center, length)
        columns = [amplitudes[:, None]]
        if order >= 2:
            waves = self.frequencies / length
            columns.append(-amplitudes[:, None] * (waves[:, :, None] * waves[:, None, :]).reshape(-1, 9))
        along = [z.cos() @ (self.frequencies * (amplitudes / length)[:, None])] if order >= 1 else []
        sums = z.sin() @ torch.cat(columns, dim=1)
        return [sums[:, 0], *along, *([sums[:, 1:].reshape(-1, 3, 3)] if order >= 2 else [])]
