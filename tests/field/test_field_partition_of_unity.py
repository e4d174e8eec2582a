"""The partition of unity: weights that sum to one, and derivatives against autodiff."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.func import jacrev, vmap

from gnrecon.field.partition_of_unity import Partition


@pytest.fixture(params=[0.2, 0.5, 1.0], ids=lambda overlap: f"overlap {overlap}")
def partition(request: pytest.FixtureRequest) -> Partition:
    return Partition(np.array([-1.03, 0.2, 7.0]), 0.31, request.param)


def cloud(partition: Partition, rng: np.random.Generator, count: int = 300) -> np.ndarray:
    return partition.origin + rng.uniform(-1.0, 1.0, (count, 3))


def test_weights_sum_to_one_and_their_derivatives_to_zero(partition: Partition, rng: np.random.Generator) -> None:
    x = cloud(partition, rng)
    sums = [np.zeros(len(x)), np.zeros((len(x), 3)), np.zeros((len(x), 3, 3))]
    keys, members = partition.members(x)
    for key, rows in zip(keys, members, strict=True):
        center = torch.as_tensor(partition.center(key))
        for total, part in zip(sums, partition.weight(torch.as_tensor(x[rows]), center, 2), strict=True):
            total[rows] += part.numpy()
    np.testing.assert_allclose(sums[0], 1.0, atol=1e-12)
    np.testing.assert_allclose(sums[1], 0.0, atol=1e-10)
    np.testing.assert_allclose(sums[2], 0.0, atol=1e-7)


def test_members_are_all_whose_weight_is_not_zero(partition: Partition, rng: np.random.Generator) -> None:
    x = cloud(partition, rng, 40)
    keys, members = partition.members(x)
    found = {(tuple(key), int(row)) for key, rows in zip(keys.tolist(), members, strict=True) for row in rows}
    own = np.floor((x - partition.origin) / partition.cell).astype(int)
    for row, near in enumerate(own):
        for offset in np.ndindex(5, 5, 5):
            key = near + np.array(offset) - 2
            weight = next(partition.weight(torch.as_tensor(x[[row]]), torch.as_tensor(partition.center(key)), 0))
            assert ((tuple(key.tolist()), row) in found) == (float(weight) > 0)
    assert keys.tolist() == sorted(keys.tolist())


@pytest.mark.parametrize("size", [0.0, 0.1, 0.7], ids=["points", "small", "larger than cubes"])
def test_a_box_meets_the_cubes_that_hold_some_of_its_points(
    partition: Partition, size: float, rng: np.random.Generator
) -> None:
    low = cloud(partition, rng, 40)
    sizes = rng.uniform(0.0, size, low.shape)
    around = partition.members(low)[0]
    lattice = np.stack([np.arange(20) + start for start in around.min(axis=0) - 3])
    cubes = np.stack(np.meshgrid(*lattice, indexing="ij"), axis=-1).reshape(-1, 3)
    keys, rows = partition.pairs_of_boxes(low, low + sizes, cubes)
    found = {(tuple(key), int(row)) for key, row in zip(keys.tolist(), rows, strict=True)}
    assert len(found) == len(rows)
    grid = np.stack(np.meshgrid(*3 * [np.linspace(0.0, 1.0, 12)], indexing="ij"), axis=-1).reshape(-1, 3)
    keys, rows = partition.pairs((low[:, None] + sizes[:, None] * grid).reshape(-1, 3))
    held = {(tuple(key), int(row)) for key, row in zip(keys.tolist(), rows // len(grid), strict=True)}
    assert held <= found
    for key, row in found:
        center = partition.center(key)
        nearest = np.clip(center, low[row], low[row] + sizes[row])
        assert (np.abs(nearest - center) <= partition.reach + 1e-12).all()
    # Of few cubes, each is compared with each box, so that boxes may be of any size.
    few = around[:3]
    keys, rows = partition.pairs_of_boxes(low, low + sizes, few)
    assert {(tuple(key), int(row)) for key, row in zip(keys.tolist(), rows, strict=True)} == {
        (key, row) for key, row in found if list(key) in few.tolist()
    }
    assert len(partition.pairs_of_boxes(low - 1e9, low + 1e9, few)[1]) == 3 * len(low)


def test_derivatives_are_those_of_autodiff(partition: Partition, rng: np.random.Generator) -> None:
    center = torch.as_tensor(partition.center((0, 0, 0)))
    x = center + torch.as_tensor(rng.uniform(-1.0, 1.0, (50, 3))) * partition.reach

    def weight(point: Tensor) -> Tensor:
        return next(partition.weight(point[None], center, 0))[0]

    _, gradient, bend = partition.weight(x, center, 2)
    torch.testing.assert_close(gradient, vmap(jacrev(weight))(x), atol=1e-10, rtol=1e-9)
    torch.testing.assert_close(bend, vmap(jacrev(jacrev(weight)))(x), atol=1e-7, rtol=1e-8)


def test_no_points_have_no_members(partition: Partition) -> None:
    keys, members = partition.members(np.zeros((0, 3)))
    assert keys.shape == (0, 3)
    assert members == []


def test_cubes_about_points_have_keys_from_minus_one_on_and_no_face_through_a_grid(rng: np.random.Generator) -> None:
    steps = np.stack(np.meshgrid(*3 * [np.arange(-3, 4)], indexing="ij"), axis=-1).reshape(-1, 3)
    for points, cell in ((0.5 * steps, 0.5), (rng.uniform(2.0, 3.0, (300, 3)), 0.2)):
        keys, _ = Partition.about(points, cell).members(points)
        assert keys.min() >= -1
    inside = (0.5 * steps - Partition.about(0.5 * steps, 0.5).origin) / 0.5 % 1.0
    assert np.minimum(inside, 1.0 - inside).min() > 0.1
