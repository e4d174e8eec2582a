"""Removing units: the field without them, which one is removed, and runs that start wider."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from gnrecon.field import Network
from gnrecon.field.layers import SINE, TANH, WAVELET
from gnrecon.residuals import signed_distance
from gnrecon.runtime.errors import UsageError
from gnrecon.shape_learning import catenoid, learn
from gnrecon.shape_learning.frozen_points import FrozenProblem, FrozenTerm
from gnrecon.shape_learning.pruning import narrower, widened, without_unit

POINTS = torch.as_tensor(np.random.default_rng(0).uniform(-1, 1, (400, 3)))


def parameters(network: Network) -> torch.Tensor:
    return network.initial(torch.Generator().manual_seed(0))


def fit_of(network: Network, theta: torch.Tensor, target: torch.Tensor) -> FrozenProblem:
    return FrozenProblem(network, [FrozenTerm("value", signed_distance, POINTS, target, 1.0)], theta)


@pytest.mark.parametrize("layer", [0, 1])
@pytest.mark.parametrize(
    ("activation", "frequencies"), [(TANH, (1.0,)), (SINE, (3.0,)), (WAVELET, (2.0, 1.0))], ids=["tanh", "sine", "wire"]
)
def test_a_unit_that_feeds_nothing_can_go(activation, frequencies, layer: int) -> None:  # type: ignore[no-untyped-def]
    network = Network((6, 5), activation, frequencies)
    theta = parameters(network)
    network.layout.layers(theta)[layer + 1][0][:, 2] = 0.0  # a view of theta
    made, rest = without_unit(network, theta, layer, 2)
    assert made.widths == ((5, 5) if layer == 0 else (6, 4))
    assert len(rest) == made.layout.count
    torch.testing.assert_close(made.value(rest, POINTS), network.value(theta, POINTS), rtol=0, atol=1e-14)


@pytest.mark.parametrize("layer", [0, 1])
def test_the_unit_that_does_nothing_is_the_one_that_goes(layer: int) -> None:
    network = Network((6, 5), SINE, (3.0,))
    theta = parameters(network)
    network.layout.layers(theta)[layer + 1][0][:, 3] = 1e-9
    target = network.value(theta, POINTS) + 1e-3
    made, rest = narrower(fit_of(network, theta, target), tuple(w - (k == layer) for k, w in enumerate(network.widths)))
    assert made.widths[layer] == network.widths[layer] - 1
    # Of the wrong unit the values would be off by a tenth and more.
    torch.testing.assert_close(made.value(rest, POINTS), network.value(theta, POINTS), rtol=0, atol=2e-3)


def test_what_a_unit_did_is_taken_over_by_its_twin() -> None:
    # Two units are the same but for their outputs, so that one of them can do the work of both.
    network = Network((6, 5), TANH)
    theta = parameters(network)
    weights, bias = network.layout.layers(theta)[1]
    weights[4], bias[4] = weights[1], bias[1]
    values = network.value(theta, POINTS)
    made, rest = narrower(fit_of(network, theta, values), (6, 4))
    torch.testing.assert_close(made.value(rest, POINTS), values, rtol=0, atol=1e-3)
    for unit in range(5):  # without that, any of them is missed by far more
        alone, bare = without_unit(network, theta, 1, unit)
        assert (alone.value(bare, POINTS) - values).abs().max() > 1e-2


def test_nothing_is_taken_from_layers_that_are_not_wider() -> None:
    network = Network((4, 4), TANH)
    theta = parameters(network)
    with pytest.raises(ValueError, match="No layer"):
        narrower(fit_of(network, theta, network.value(theta, POINTS)), (4, 4))
    assert widened(network, 2).widths == (6, 6)


def test_a_run_that_began_wider_ends_with_the_problems_network() -> None:
    problem = replace(catenoid(), network=Network((8, 8), TANH))
    learned = learn(problem, steps=30, budget=None, wider=1)
    assert learned.field.network.widths == (8, 8)
    assert len(learned.field.theta) == problem.network.layout.count
    assert [record.step for record in learned.solution.history] == list(range(1, 31))
    assert "had more units" in learned.solution.status
    assert learned.best.loss < 0.1 * learned.history[0].loss
    assert learned.best in learned.history


def test_a_run_of_fewer_steps_than_units_to_lose_has_the_problems_network_too() -> None:
    problem = replace(catenoid(), network=Network((6, 6), TANH))
    learned = learn(problem, steps=2, budget=None, wider=2)
    assert learned.field.network.widths == (6, 6)
    assert len(learned.solution.history) == 2


@pytest.mark.parametrize(("optimiser", "wider"), [("gn", -1), ("adam", 2), ("lbfgs", 1)])
def test_only_gauss_newton_begins_wider(optimiser: str, wider: int) -> None:
    with pytest.raises(UsageError, match="wider"):
        learn(catenoid(), optimiser, steps=1, budget=None, wider=wider)
