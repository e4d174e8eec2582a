"""Accumulating J^T J from chunks of rows, as a symmetric rank-k update.

Only the blocks on and below the diagonal are multiplied, which halves the work of a full product and reaches the
matrix-product rate of the device; J itself is never held.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

BLOCK = 192


def gram(chunks: Iterable[Tensor], size: int, like: Tensor) -> Tensor:
    """Return J^T J, of shape (size, size), its lower triangle valid, summed in `like`'s precision and on its device.

    Parameters
    ----------
    chunks : J's rows, of shape (m, size); products of chunks in a lower precision are made in theirs, which is faster,
        and only their sums are kept in `like`'s
    size : number of columns of J
    like : tensor whose dtype and device are used
    """
    product = torch.zeros(size, size, dtype=like.dtype, device=like.device)
    for rows in chunks:
        for start in range(0, size, BLOCK):
            stop = min(start + BLOCK, size)
            place = product[start:stop, :stop]
            if rows.dtype == like.dtype:
                place.addmm_(rows[:, start:stop].T, rows[:, :stop])
            else:
                place += rows[:, start:stop].T @ rows[:, :stop]
    return product
