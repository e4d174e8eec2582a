"""Products of matrices where each has one thread, by the BLAS that is faster there."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor


def matmul(left: Tensor, right: Tensor) -> Tensor:
    """Return A B for matrices, or matrices and vectors, of one precision on one device.

    Where torch has one thread, numpy's BLAS takes it on the CPU: it knows processors of all makers, while that of torch
    needs up to twice the time on some of them, and it takes half of the time for a matrix by its own transpose. Where
    torch has several threads, those of two libraries would wait for each other.
    """
    if left.device.type != "cpu" or torch.get_num_threads() > 1:
        return left @ right
    try:
        first, second = left.numpy(), right.numpy()
    except RuntimeError:  # of tensors whose derivatives are followed, by autograd or torch.func
        return left @ right
    # As torch does, it says nothing about numbers that are not finite.
    with np.errstate(all="ignore"):
        return torch.from_numpy(first @ second)
