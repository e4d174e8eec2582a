"""Removes the hidden units that cost least, because a network that starts wider ends in a lower minimum.

A unit is removed by setting its q weights into the next layer to zero. In the linear model of the residuals, with
H = J^T J + shift I, this costs  q . B^-1 q / 2,  with B the block of H^-1 at q, if the other parameters move by
-H^-1[:, q] B^-1 q. Steps of the optimiser then correct the error of the model.
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


@dataclass(frozen=True)
class _Removal:
    """The predicted cost of removing a hidden unit, and the predicted move of all parameters, of shape (p,)."""

    layer: int
    unit: int
    cost: float
    move: Tensor


def widened(network: Network, more: int) -> Network:
    """Return the network with `more` additional units in each hidden layer."""
    return replace(network, widths=tuple(width + more for width in network.widths))


def narrower(
    problem: FrozenProblem, goal: tuple[int, ...], *, candidates: int = 4, move_shares: tuple[float, ...] = (1.0, 0.5)
) -> tuple[Network, Tensor]:
    """Return the problem's network without one unit, and its parameters, of shape (p',).

    Parameters
    ----------
    goal : widths; only layers that are wider lose a unit
    candidates : units of the least predicted cost whose removal is evaluated; the one with the least loss is removed
    move_shares : fractions of the predicted move that are tried, as it is often longer than the range of the model

    Raises
    ------
    ValueError
        When no layer is wider.
    """
    found = sorted(_removals(problem, goal), key=lambda removal: removal.cost)[:candidates]
    if not found:
        raise ValueError(f"No layer of {problem.network.widths} is wider than {goal}.")
    trials = [
        without_unit(problem.network, problem.theta + share * removal.move, removal.layer, removal.unit)
        for removal in found
        for share in move_shares
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


def _removals(problem: FrozenProblem, goal: tuple[int, ...], *, shift: float = 1e-7) -> Iterator[_Removal]:
    """Yield the removal of each unit of the layers wider than the goal.

    `shift` is relative to the largest diagonal entry of J^T J, above the rounding of rows stored in float32.
    """
    network, theta = problem.network, problem.theta
    jacobian, _ = problem.linearise(theta)
    product = jacobian.gram()
    factor = damped_factor(product, shift * product.diagonal().max().expand(len(product)))
    if factor is None:  # J is not finite, or all rounding: rank by the weights alone
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
