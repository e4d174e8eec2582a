"""Jacobian rows written out, for comparison with what is differentiated automatically."""

from __future__ import annotations

import torch
from torch import Tensor

from gnrecon.least_squares import LayerRows


def dense(layers: list[LayerRows]) -> Tensor:
    """All columns of the rows, in theta's order."""
    blocks = []
    for layer in layers:
        block = layer.left.new_full((len(layer.left), layer.size), torch.nan)
        layer.write(block)
        blocks.append(block)
    return torch.cat(blocks, dim=1)
