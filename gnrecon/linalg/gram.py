"""Accumulating J^T J from chunks of rows, as a symmetric rank-k update.

Only the blocks on and below the diagonal are multiplied, which halves the work of a full product and reaches the
matrix-product rate of the device; J itself is never held.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

BLOCK = 512


def gram(chunks: Iterable[tuple[Tensor, Tensor]], size: int, like: Tensor) -> tuple[Tensor, Tensor, float]:
    """Return J^T J (lower triangle valid), J^T r, and r^T r, summed in `like`'s precision and on its device.

    Parameters
    ----------
    chunks : pairs of J's rows, of shape (m, size), and their residuals, of shape (m,)
    size : number of columns of J
    like : tensor whose dtype and device are used
    """
    product = torch.zeros(size, size, dtype=like.dtype, device=like.device)
    projected = torch.zeros(size, dtype=like.dtype, device=like.device)
    square = torch.zeros((), dtype=like.dtype, device=like.device)
    for rows, residual in chunks:
        for start in range(0, size, BLOCK):
            stop = min(start + BLOCK, size)
            product[start:stop, :stop].addmm_(rows[:, start:stop].T, rows[:, :stop])
        projected.addmv_(rows.T, residual)
        square += residual @ residual
    return product, projected, float(square)
