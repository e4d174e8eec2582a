"""Sines at points that lie alike around many centres, such as the nodes of a lattice's blocks.

    sin(F . (c + o) + p) = sin(F . c + p) cos(F . o) + cos(F . c + p) sin(F . o)

Sums of m sines at K offsets from each of N centres so take N m sines and cosines and two matrix products, in place of
N K m sines.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class Stencil:
    """What m features turn by from a centre to K offsets from it: cosine and sine of F . o, both of shape (m, K)."""

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
        along = phases.cos().mul_(amplitudes) @ self.sine
        return along.addmm_(phases.sin().mul_(amplitudes), self.cosine)
