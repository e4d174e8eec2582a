"""What a level set can be measured against: a surface that can be sampled, and whose nearest points are found."""

from __future__ import annotations

from typing import Protocol

from torch import Tensor


class KnownSurface(Protocol):
    """A surface, or a patch of one, that is known."""

    def sample(self, count: int) -> tuple[Tensor, Tensor]:
        """Return about `count` points, of shape (M, 3), and the share of the area that each stands for, (M,)."""
        ...

    def nearest(self, queries: Tensor) -> tuple[Tensor, Tensor]:
        """Return the nearest points, of shape (N, 3), to queries, (N, 3), and whether they are of the patch, (N,)."""
        ...
