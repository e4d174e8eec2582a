"""Larger sine networks of known functions: a network with more units, and the mean of several networks.

*Widening* (`widened`) adds units to every hidden layer, and the function stays the same. New units have random incoming
weights, and outgoing weights of zero to all units that were there before. The function is therefore unchanged, but its
derivatives by the new outgoing weights are not zero, so that Gauss-Newton uses the new units from its first step on.
Source: Chen, Goodfellow and Shlens, *Net2Net: Accelerating Learning via Knowledge Transfer* (2016), with new units in
place of copies, which a second-order method would leave equal.

*The mean* (`mean_of`) of networks of the same depth is again one network, whose hidden layers hold those of all.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from gnrecon.field.networks import Siren


def widened(
    field: Siren, theta: Tensor, width: int, rng: np.random.Generator, frequency: float
) -> tuple[Siren, Tensor]:
    """Return the network with `width` units in each hidden layer, and its parameters, of shape (p,).

    Parameters
    ----------
    field : network whose hidden layers have one width, at most `width`
    theta : its parameters
    width : units of each hidden layer
    rng : draws the incoming weights of the new units
    frequency : standard deviation of the frequencies of new units of the first layer, per unit of length
    """
    before, layers = field.layout.layers(theta), []
    added = width - field.widths[0]
    for number, (weights, bias) in enumerate(before):
        out, into = weights.shape
        if number > 0:
            weights = torch.cat([weights, weights.new_zeros(out, added)], 1)
        if number < len(before) - 1:
            if number == 0:
                incoming = frequency * rng.standard_normal((added, into))
            else:
                # As at the start of a fit: they keep the variance of sines (Sitzmann et al., theorem 1.8).
                bound = np.sqrt(6.0 / width)
                incoming = rng.uniform(-bound, bound, (added, width))
            weights = torch.cat([weights, torch.as_tensor(incoming).to(weights)])
            bias = torch.cat([bias, torch.as_tensor(rng.uniform(-np.pi, np.pi, added)).to(bias)])
        layers.append((weights, bias))
    wide = Siren((width,) * len(field.widths))
    return wide, wide.layout.flatten(layers)


def mean_of(networks: Sequence[tuple[Siren, Tensor]]) -> tuple[Siren, Tensor]:
    """Return the network, and its parameters, whose function is the mean of those of networks of one depth."""
    by_layer = list(zip(*(field.layout.layers(theta) for field, theta in networks), strict=True))
    layers = []
    for number, layer in enumerate(by_layer):
        weights, biases = [one[0] for one in layer], [one[1] for one in layer]
        if number == 0:
            layers.append((torch.cat(weights), torch.cat(biases)))
        elif number < len(by_layer) - 1:
            layers.append((_block_diagonal(weights), torch.cat(biases)))
        else:
            layers.append((torch.cat(weights, 1) / len(networks), torch.stack(biases).mean(0)))
    whole = Siren(tuple(len(bias) for _, bias in layers[:-1]))
    return whole, whole.layout.flatten(layers)


def _block_diagonal(blocks: Sequence[Tensor]) -> Tensor:
    """Return the matrix with the blocks along its diagonal and zeros elsewhere."""
    whole = blocks[0].new_zeros(sum(len(block) for block in blocks), sum(block.shape[1] for block in blocks))
    row = column = 0
    for block in blocks:
        whole[row : row + len(block), column : column + block.shape[1]] = block
        row, column = row + len(block), column + block.shape[1]
    return whole
