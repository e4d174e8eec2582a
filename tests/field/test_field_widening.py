"""Widened networks and means of networks, as functions."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gnrecon.field.networks import Siren
from gnrecon.field.widening import mean_of, widened


@pytest.mark.parametrize("depth", [1, 2, 3])
def test_a_widened_network_is_the_same_function(depth: int, rng: np.random.Generator) -> None:
    field = Siren((5,) * depth)
    theta = torch.as_tensor(rng.standard_normal(field.layout.count))
    wide, wide_theta = widened(field, theta, 9, rng, frequency=4.0)
    assert wide.widths == (9,) * depth
    x = torch.as_tensor(rng.uniform(-1, 1, (50, 3)))
    for before, after in zip(field.value_and_gradient(theta, x), wide.value_and_gradient(wide_theta, x), strict=True):
        torch.testing.assert_close(before, after)


def test_new_units_can_be_used_at_once(rng: np.random.Generator) -> None:
    field = Siren((4, 4))
    wide, theta = widened(field, torch.as_tensor(rng.standard_normal(field.layout.count)), 6, rng, frequency=4.0)
    x = torch.as_tensor(rng.uniform(-1, 1, (50, 3)))
    theta.requires_grad_(True)
    wide.value(theta.clone(), x).square().sum().backward()
    assert theta.grad is not None
    (into, _), (hidden, _), (out, _) = wide.layout.layers(theta.grad)
    assert (hidden[:4, 4:] != 0).all(), "new units lead into the units that were there"
    assert (out[0, 4:] != 0).all(), "new units of the last hidden layer lead into the value"
    assert (into[4:] == 0).all(), "as their outgoing weights are zero, how they begin does not matter yet"


def test_the_mean_of_networks_is_a_network(rng: np.random.Generator) -> None:
    fields = [Siren((3, 5, 2)), Siren((4, 4, 4))]
    networks = [(field, torch.as_tensor(rng.standard_normal(field.layout.count))) for field in fields]
    whole, theta = mean_of(networks)
    assert whole.widths == (7, 9, 6)
    x = torch.as_tensor(rng.uniform(-1, 1, (50, 3)))
    expected = sum(field.value(one, x) for field, one in networks) / 2
    torch.testing.assert_close(whole.value(theta, x), expected)
    single, same = mean_of(networks[:1])
    torch.testing.assert_close(single.value(same, x), fields[0].value(networks[0][1], x))
