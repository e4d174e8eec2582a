"""Widening of a sine network: units are added to every hidden layer, and the function stays the same.

New units have random incoming weights, and outgoing weights of zero to all units that were there before. The function
is therefore unchanged, but its derivatives by the new outgoing weights are not zero, so that Gauss-Newton uses the new
units from its first step on.
Source: Chen, Goodfellow and Shlens, *Net2Net: Accelerating Learning via Knowledge Transfer* (2016), with new units in
place of copies, which a second-order method would leave equal.
"""

from __future__ import annotations

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
            # As at the start of a fit: hidden weights that keep the variance of sines (Sitzmann et al., theorem 1.8).
            bound = np.sqrt(6.0 / width)
            incoming = frequency * rng.standard_normal((added, into)) if number == 0 else None
            if incoming is None:
                incoming = rng.uniform(-bound, bound, (added, width))
            weights = torch.cat([weights, torch.as_tensor(incoming).to(weights)])
            bias = torch.cat([bias, torch.as_tensor(rng.uniform(-np.pi, np.pi, added)).to(bias)])
        layers.append((weights, bias))
    wide = Siren((width,) * len(field.widths))
    return wide, wide.layout.flatten(layers)
