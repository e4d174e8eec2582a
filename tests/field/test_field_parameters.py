"""The parameters of the field: frozen, all of them used, and with effect."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import torch
from parameter_checks import assert_frozen, read_attributes

import gnrecon.field
from gnrecon.field.field_parameters import FieldParameters
from gnrecon.field.partition_of_unity import Detail, Partition
from gnrecon.field.random_features import Features

DEFAULT = FieldParameters()


def test_they_are_frozen() -> None:
    assert_frozen(DEFAULT)


def test_each_is_used() -> None:
    assert {field.name for field in fields(DEFAULT)} <= read_attributes(gnrecon.field)


def test_degrees_of_freedom_change_the_features() -> None:
    def frequencies(**options: float) -> torch.Tensor:
        rng = np.random.default_rng(0)
        return Features.draw(20, rng, torch.zeros(0, dtype=torch.float64), **options).frequencies

    assert torch.equal(frequencies(), frequencies(degrees_of_freedom=DEFAULT.degrees_of_freedom))
    assert not torch.equal(frequencies(), frequencies(degrees_of_freedom=4.0))


def test_batches_do_not_change_values(rng: np.random.Generator) -> None:
    features = Features.draw(5, rng, torch.zeros(0, dtype=torch.float64))
    partition = Partition(np.zeros(3), 0.5)
    keys = np.array([[0, 0, k] for k in range(4)])
    detail = Detail(partition, keys, np.full(4, 0.2), features, torch.ones(4, 5, dtype=torch.float64), 1e-3, 0.1)
    x, offsets = rng.uniform(0.0, [0.5, 0.5, 2.0], (30, 3)), rng.uniform(-0.1, 0.1, (7, 3))
    around = detail.value_around(x, offsets)
    np.testing.assert_array_equal(around, detail.value_around(x, offsets, batch_values=DEFAULT.batch_stencil_values))
    np.testing.assert_allclose(detail.value_around(x, offsets, batch_values=21), around, rtol=0, atol=1e-14)
