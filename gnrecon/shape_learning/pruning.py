"""Taking hidden units away where that costs least: a network that began wider ends in a lower minimum than others.

A unit is gone once its q weights into the next layer are zero. Within the linear model of the residuals, with
H = J^T J + shift I, that costs  q . B^-1 q / 2,  B being the block of H^-1 at q, when the other parameters move by
-H^-1[:, q] B^-1 q. Steps of the optimiser then make up for what the model did not see.
Source: Hassibi and Stork, Second order derivatives for network pruning: optimal brain surgeon (1993), with the
Gauss-Newton matrix in the place of the Hessian.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gnrecon.field import Network
from gnrecon.least_squares.direct import damped_factor
from gnrecon.optim.problem import loss_of
from gnrecon.shape_learning.frozen_points import FrozenProblem

SHIFT = 1e-7
"""Of J^T J's largest diagonal entry: less is lost in rounding where rows are stored in float32."""

TRIED = 4
"""Units of the least predicted cost whose removal is evaluated."""

SHARES = 1.0, 0.5
"""Shares of what the model says the others should move by that are tried; it reaches far beyond where it holds."""


@dataclass(frozen=True)
class _Removal:
    """What taking away a hidden unit of a layer would cost, and how the other parameters, of shape (p,), would move."""

    layer: int
    unit: int
    cost: float
    move: Tensor


def widened(network: Network, more: int) -> Network:
    """Return the network with so many more units in each hidden layer."""
    return replace(network, widths=tuple(width + more for width in network.widths))


def narrower(problem: FrozenProblem, goal: tuple[int, ...]) -> tuple[Network, Tensor]:
    """Return the problem's network without one unit, and its parameters, of shape (p',).

    It is the one whose loss is the least, of some that the linear model finds cheap, in layers wider than `goal`.

    Raises
    ------
    ValueError
        When no layer is wider.
    """
    found = sorted(_removals(problem, goal), key=lambda removal: removal.cost)[:TRIED]
    if not found:
        raise ValueError(f"No layer of {problem.network.widths} is wider than {goal}.")
    trials = [
        without_unit(problem.network, problem.theta + share * removal.move, removal.layer, removal.unit)
        for removal in found
        for share in SHARES
    ]
    return min(trials, key=lambda trial: _loss(problem, *trial))


def without_unit(network: Network, theta: Tensor, layer: int, unit: int) -> tuple[Network, Tensor]:
    """Return the network, and its parameters, without one unit of a hidden layer, counted from zero."""
    layers = list(network.layout.layers(theta))
    width = network.widths[layer]
    kept = torch.arange(width)[torch.arange(width) != unit]
    own = torch.cat([part * width + kept for part in range(network.activation.inputs)])
    (weights, bias), (following, offset) = layers[layer], layers[layer + 1]
    layers[layer], layers[layer + 1] = (weights[own], bias[own]), (following[:, kept], offset)
    widths = (*network.widths[:layer], width - 1, *network.widths[layer + 1 :])
    made = replace(network, widths=widths)
    return made, made.layout.flatten(layers)


def _removals(problem: FrozenProblem, goal: tuple[int, ...]) -> Iterator[_Removal]:
    """Yield what each unit of the layers wider than the goal would cost."""
    network, theta = problem.network, problem.theta
    jacobian, _ = problem.linearise(theta)
    product = jacobian.gram()
    factor = damped_factor(product, SHIFT * product.diagonal().max().expand(len(product)))
    if factor is None:  # J is not finite, or of rounding: weights alone must tell then
        factor = torch.eye(len(product)).to(product)
    inverse = torch.cholesky_inverse(factor)
    for layer, width in enumerate(network.widths):
        out, into = network.layout.shapes[layer + 1]
        for unit in range(width if width > goal[layer] else 0):
            outgoing = network.layout.offsets[layer + 1] + torch.arange(out) * into + unit
            weights = theta[outgoing].to(inverse)
            pull = torch.linalg.solve(inverse[outgoing][:, outgoing], weights)
            move = -(inverse[:, outgoing] @ pull)
            yield _Removal(layer, unit, 0.5 * float(weights @ pull), move.to(theta))


def _loss(problem: FrozenProblem, network: Network, theta: Tensor) -> float:
    """Return |r|^2 / 2 of another network on the same points; infinite where it is not finite."""
    loss = loss_of(replace(problem, network=network, theta=theta), theta)
    return loss if math.isfinite(loss) else math.inf
