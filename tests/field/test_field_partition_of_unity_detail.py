"""Local detail against a direct implementation of its formula, and against finite differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from gnrecon.field.field_parameters import FieldParameters
from gnrecon.field.partition_of_unity import Detail, Partition
from gnrecon.field.random_features import Features
from gnrecon.runtime.compute_limits import limited


def detail(rng: np.random.Generator, cubes: int = 5, features: int = 7) -> Detail:
    keys = np.array([[0, 0, k] for k in range(cubes)])
    parts = (rng.standard_normal((features, 3)), rng.uniform(0, 6, features), rng.standard_normal((cubes, features)))
    frequencies, phases, amplitudes = (torch.as_tensor(part) for part in parts)
    return Detail(
        Partition(np.array([0.1, 0.2, 0.3]), 0.5),
        keys,
        rng.uniform(0.1, 0.3, cubes),
        Features(frequencies, phases),
        amplitudes,
        1e-3,
        0.1,
    )


def plainly(of: Detail, x: np.ndarray) -> float:
    """d at one point, cube by cube."""
    total = 0.0
    for number, key in enumerate(of.keys):
        center = of.partition.center(key)
        if (np.abs(x - center) >= of.partition.reach).any():
            continue
        weight = float(next(of.partition.weight(torch.as_tensor(x[None]), torch.as_tensor(center), 0)))
        y = (x - center) / of.lengths[number]
        z = of.features.frequencies.numpy() @ y + of.features.phases.numpy()
        total += weight * float(of.amplitudes[number].numpy() @ np.sin(z))
    return total


def points(of: Detail, rng: np.random.Generator, count: int = 60) -> np.ndarray:
    return of.partition.origin + rng.uniform([-0.3, -0.3, -0.3], [0.8, 0.8, 2.8], (count, 3))


def test_it_is_the_blend_of_its_cubes(rng: np.random.Generator) -> None:
    of = detail(rng)
    x = points(of, rng)
    np.testing.assert_allclose(of.value(x), [plainly(of, point) for point in x], atol=1e-12)
    assert (of.value(of.partition.origin + np.array([[-5.0, 0, 0], [0.2, 0.2, 9.0]])) == 0).all()


@pytest.mark.parametrize("reach", [0.05, 0.4, 1.6], ids=["within a cube", "as large as one", "larger than cubes"])
def test_around_centres_it_is_what_it_is_at_each_point(reach: float, rng: np.random.Generator) -> None:
    of = detail(rng)
    x, offsets = points(of, rng), rng.uniform(-reach, reach, (11, 3))
    expected = of.value((x[:, None] + offsets).reshape(-1, 3)).reshape(len(x), -1)
    np.testing.assert_allclose(of.value_around(x, offsets), expected, rtol=0, atol=1e-12)
    assert np.abs(expected).max() > 0.1


def test_around_many_centres_threads_change_nothing(rng: np.random.Generator) -> None:
    of = detail(rng)
    offsets = rng.uniform(-0.1, 0.1, (64, 3))
    x = points(of, rng, 2 * FieldParameters.batch_stencil_values // len(offsets) + 5)
    found = []
    for count in (1, 2):
        with limited(count):
            found.append(of.value_around(x, offsets))
    np.testing.assert_array_equal(*found)
    np.testing.assert_allclose(found[0][-1], of.value(x[-1] + offsets), rtol=0, atol=1e-12)


def test_derivatives_are_those_of_differences(rng: np.random.Generator) -> None:
    of = detail(rng)
    x, h = points(of, rng), 1e-5
    value, gradient = of.value_and_gradient(x)
    np.testing.assert_array_equal(value, of.value(x))
    steps = h * np.eye(3)
    slopes = np.stack([(of.value(x + step) - of.value(x - step)) / (2 * h) for step in steps], axis=1)
    np.testing.assert_allclose(gradient, slopes, atol=1e-6)
    bends = [(of.value_and_gradient(x + step)[1] - of.value_and_gradient(x - step)[1]) / (2 * h) for step in steps]
    np.testing.assert_allclose(of.hessian(x), np.stack(bends, axis=2), atol=1e-3)


def test_many_points_are_what_each_is_alone_with_any_number_of_threads(rng: np.random.Generator) -> None:
    of = detail(rng)
    x = points(of, rng, 2 * FieldParameters.batch_points + 5)
    found = []
    for count in (1, 2):
        with limited(count):
            found.append(of.value_and_gradient(x))
    for one, other in zip(*found, strict=True):
        np.testing.assert_array_equal(one, other)
    some = [0, FieldParameters.batch_points - 1, FieldParameters.batch_points, len(x) - 1]
    np.testing.assert_allclose(found[0][0][some], [plainly(of, point) for point in x[some]], atol=1e-12)


def test_a_key_that_no_cube_has_is_zero_there(rng: np.random.Generator) -> None:
    of = detail(rng)
    x = points(of, rng)
    gone = replace(of, keys=np.delete(of.keys, 2, axis=0), lengths=np.delete(of.lengths, 2))
    gone = replace(gone, amplitudes=of.amplitudes[[0, 1, 3, 4]])
    np.testing.assert_allclose(gone.value(x), [plainly(gone, point) for point in x], atol=1e-12)


def test_without_cubes_it_is_nothing(rng: np.random.Generator) -> None:
    of = detail(rng)
    none = replace(of, keys=of.keys[:0], lengths=of.lengths[:0], amplitudes=of.amplitudes[:0])
    for part in none.value_and_gradient(points(of, rng)):
        assert (part == 0).all()


def test_single_precision_is_near_and_counts_are_right(rng: np.random.Generator) -> None:
    of = detail(rng)
    x = points(of, rng)
    np.testing.assert_allclose(of.to(torch.float32).value(x), of.value(x), atol=2e-6 * float(of.amplitudes.abs().sum()))
    assert of.count == 5 * 7 + 7 * 3 + 7 + 5
    assert of.as_dict(2.0)["position_noise"] == 2e-3


def test_a_coarser_detail_is_added(rng: np.random.Generator) -> None:
    of, other = detail(rng), detail(rng, 3, 4)
    both, x, offsets = replace(of, coarser=other), points(of, rng), rng.uniform(-0.3, 0.3, (11, 3))
    assert list(both.levels) == [both, other]
    assert both.count == of.count + other.count
    np.testing.assert_allclose(both.value(x), of.value(x) + other.value(x), atol=1e-14)
    for whole, one, more in zip(*(each.value_and_gradient(x) for each in (both, of, other)), strict=True):
        np.testing.assert_allclose(whole, one + more, atol=1e-12)
    np.testing.assert_allclose(both.hessian(x), of.hessian(x) + other.hessian(x), atol=1e-10)
    around = of.value_around(x, offsets) + other.value_around(x, offsets)
    np.testing.assert_allclose(both.value_around(x, offsets), around, atol=1e-12)
    single = both.to(torch.float32)
    assert single.coarser is not None
    assert single.coarser.amplitudes.dtype == torch.float32
