"""The flat parameter vector: where things lie, and the starting parameters."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
import torch

from gnrecon.field import Siren
from gnrecon.field.layers import Layout

SIZES = [(3, 4, 1), (3, 5, 2, 1), (2, 3, 3, 4)]


@pytest.mark.parametrize("sizes", SIZES, ids=str)
def test_layers_and_flatten_are_inverse(sizes: tuple[int, ...]) -> None:
    layout = Layout(sizes)
    theta = torch.arange(layout.count, dtype=torch.float64)
    layers = layout.layers(theta)
    assert [tuple(weights.shape) for weights, _ in layers] == list(layout.shapes)
    assert [len(bias) for _, bias in layers] == list(sizes[1:])
    assert torch.equal(layout.flatten(layers), theta)
    assert layout.count == sum((into + 1) * out for into, out in pairwise(sizes))


def test_layers_are_views() -> None:
    layout = Layout((3, 4, 1))
    theta = torch.zeros(layout.count)
    weights, bias = layout.layers(theta)[1]
    weights += 1.0
    bias += 2.0
    assert theta.tolist() == [0.0] * 16 + [1.0] * 4 + [2.0]


@pytest.mark.parametrize("sizes", SIZES, ids=str)
def test_columns_agree_with_direct_indexing(sizes: tuple[int, ...]) -> None:
    layout = Layout(sizes)
    theta = torch.arange(layout.count)
    generator = torch.Generator().manual_seed(3)
    units = [torch.randperm(out, generator=generator)[: max(1, out // 2)] for out in sizes[1:]]
    expected = [
        part
        for (W, b), chosen in zip(layout.layers(theta), units, strict=True)
        for part in (W[chosen].flatten(), b[chosen])
    ]
    assert torch.equal(theta[layout.columns(units)], torch.cat(expected))
    assert torch.equal(layout.columns([None] * len(layout.shapes)), theta)
    none = torch.zeros(0, dtype=torch.long)
    last_only = layout.columns([*(none for _ in layout.shapes[:-1]), None])
    assert torch.equal(last_only, theta[layout.offsets[-1] :])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_initial_parameters_are_uniform_within_the_fan_in(dtype: torch.dtype) -> None:
    field = Siren((400, 100))
    theta = field.initial(torch.Generator().manual_seed(0), dtype)
    assert theta.dtype == dtype
    assert theta.shape == (field.layout.count,)
    for (weights, bias), (_, into) in zip(field.layout.layers(theta), field.layout.shapes, strict=True):
        bound = 1 / math.sqrt(into)
        assert float(weights.abs().max()) <= bound
        assert float(bias.abs().max()) <= bound
        assert float(weights.std()) == pytest.approx(bound / math.sqrt(3), rel=0.15)
    again = field.initial(torch.Generator().manual_seed(0), dtype)
    assert torch.equal(theta, again)
    assert not torch.equal(theta, field.initial(torch.Generator().manual_seed(1), dtype))
