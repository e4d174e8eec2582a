"""Random sine features: functions that are weighted sums of one layer of fixed frequencies and phases.

    c(x) = sum_j a_j sin(F_j . (x - c_0) / l + p_j)

Frequencies F are drawn for a length of one, so one draw can be used for functions of any length l around any centre
c_0. With independent normal amplitudes, c is a Gaussian process whose covariance is a mean over the features, and
features that fill their distribution evenly are closer to the exact one than as many independent ones: by a factor of
two for 300 to 700 features. So the radius, direction and phase of each are those of a scrambled Sobol sequence.
Source: Rahimi and Recht, *Random Features for Large-Scale Kernel Machines* (2007); Avron, Sindhwani, Yang and Mahoney,
*Quasi-Monte Carlo Feature Maps for Shift-Invariant Kernels* (2016).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from scipy.special import fdtri
from torch import Tensor

from gnrecon.field.field_parameters import FieldParameters
from gnrecon.geometry.arrays import Float
from gnrecon.runtime.matrix_product import matmul


@dataclass(frozen=True)
class Features:
    """Frequencies for a length of one, of shape (m, 3), and phases, of shape (m,)."""

    frequencies: Tensor
    phases: Tensor

    @classmethod
    def draw(
        cls,
        count: int,
        rng: np.random.Generator,
        like: Tensor,
        *,
        degrees_of_freedom: float = FieldParameters.degrees_of_freedom,
    ) -> Features:
        """Draw features whose frequencies have a Student t distribution; more degrees of freedom are smoother.

        Also the first of them (`first`) fill it evenly.
        """
        even = torch.quasirandom.SobolEngine(4, scramble=True, seed=int(rng.integers(2**31)))  # type: ignore[no-untyped-call]
        share, height, turn, phase = even.draw(count, dtype=torch.float64).numpy().T
        # |F|^2 / 3 has Fisher's F distribution; heights and turns about the axis are those of a uniform direction.
        radius = np.sqrt(3.0 * fdtri(3, degrees_of_freedom, share))
        height, turn, phases = 2.0 * height - 1.0, 2 * np.pi * turn, 2 * np.pi * phase
        around = np.sqrt(1.0 - height**2)
        frequencies = radius[:, None] * np.stack([around * np.cos(turn), around * np.sin(turn), height], axis=1)
        return cls(torch.as_tensor(frequencies).to(like), torch.as_tensor(phases).to(like))

    def __len__(self) -> int:
        return len(self.phases)

    def to(self, dtype: torch.dtype) -> Features:
        """Return the same features in another precision."""
        if dtype == self.frequencies.dtype:
            return self
        return self._single if dtype == torch.float32 else Features(self.frequencies.to(dtype), self.phases.to(dtype))

    @cached_property
    def _single(self) -> Features:
        """The features in single precision."""
        return Features(self.frequencies.float(), self.phases.float())

    def precise_enough(self, trace: float, *, most_single_trace: float = 1e5) -> Features:
        """Return the features in single precision where its rounding is far less than a prior's ones, or as they are.

        `trace` is that of J^T J for features of variance one over the prior's: its largest eigenvalue is at most so
        large.
        """
        return self.to(torch.float32) if trace < most_single_trace else self

    def first(self, count: int) -> Features:
        """Return the first of the features, at most so many."""
        return Features(self.frequencies[:count], self.phases[:count])

    @cached_property
    def products(self) -> Tensor:
        """Inner products of the frequencies, of shape (m, m)."""
        return self.frequencies @ self.frequencies.T

    @cached_property
    def _affine(self) -> Tensor:
        """Frequencies and phases in one matrix, of shape (4, m); a product with it is faster than one and a sum."""
        return torch.cat([self.frequencies.T, self.phases[None]])

    def local(self, x: Tensor, center: Tensor, length: float | Tensor) -> Tensor:
        """Return (x - center) / length with a column of ones, of shape (N, 4), in the features' precision.

        Parameters
        ----------
        x : of shape (N, 3)
        center : of shape (3,), or (N, 3)
        length : one, or of shape (N, 1)
        """
        # Subtract the centre first, so that single precision does not lose digits.
        return torch.nn.functional.pad(((x - center) / length).to(self.frequencies), (0, 1), value=1.0)

    def phase(self, x: Tensor, center: Tensor, length: float) -> Tensor:
        """Return F . (x - center) / length + p, of shape (N, m), in the features' precision."""
        return self.local(x, center, length) @ self._affine

    def stencil(self, offsets: Float) -> Stencil:
        """Return the stencil for offsets over the length, of shape (K, 3), see `Stencil`."""
        return Stencil.of(self.frequencies, torch.as_tensor(offsets).to(self.frequencies))

    def sums(self, amplitudes: Tensor, x: Tensor, center: Tensor, length: float, order: int) -> list[Tensor]:
        """Return c at x, of shape (N, 3), and its derivatives in space up to an order of at most two.

        Returns
        -------
        list of Tensor
            Of shapes (N,), (N, 3) and (N, 3, 3).
        """
        sums = self.sums_of(self.local(x, center, length), amplitudes, order)
        return [part / length**k for k, part in enumerate(sums)]

    def sums_of(self, local: Tensor, amplitudes: Tensor, order: int) -> list[Tensor]:
        """Return the result of `sums`, with derivatives with respect to x / length.

        Parameters
        ----------
        local : of shape (N, 4), points as `local` gives them
        amplitudes : of shape (m,), or (N, m) of each point its own
        order : int
        """
        z = local @ self._affine
        along = [(z.cos().mul_(amplitudes)) @ self.frequencies] if order >= 1 else []
        weighted = z.sin_().mul_(amplitudes)
        bent = [-(weighted @ self._squares).reshape(-1, 3, 3)] if order >= 2 else []
        return [weighted.sum(dim=1), *along, *bent]

    @cached_property
    def _squares(self) -> Tensor:
        """Products of each frequency's components, of shape (m, 9)."""
        return (self.frequencies[:, :, None] * self.frequencies[:, None, :]).reshape(-1, 9)


# Sines at the same offsets around many centres, such as the nodes of a lattice's blocks.
#
#     sin(F . (c + o) + p) = sin(F . c + p) cos(F . o) + cos(F . c + p) sin(F . o)
#
# Sums of m sines at K offsets from each of N centres therefore take N m sines and cosines and two matrix products
# instead of N K m sines.


@dataclass(frozen=True)
class Stencil:
    """The phase shifts of m features from a centre to K offsets: cosine and sine of F . o, both of shape (m, K)."""

    cosine: Tensor
    sine: Tensor

    @classmethod
    def of(cls, frequencies: Tensor, offsets: Tensor) -> Stencil:
        """Return the stencil of frequencies, of shape (m, 3), for offsets, of shape (K, 3)."""
        turned = frequencies @ offsets.T
        return cls(turned.cos(), turned.sin_())

    def sums(self, phases: Tensor, amplitudes: Tensor) -> Tensor:
        """Return the weighted sums of the sines, of shape (N, K), by their phases at the centres.

        Parameters
        ----------
        phases : of shape (N, m), F . c + p
        amplitudes : of shape (m,), or (N, m) of each centre its own
        """
        along = matmul(phases.cos().mul_(amplitudes), self.sine)
        return along.add_(matmul(phases.sin().mul_(amplitudes), self.cosine))
