"""Normal equations and damped steps against dense products and torch's least-squares solver."""

from __future__ import annotations

import math
from collections.abc import Iterator

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from gnrecon.linalg import identity, jacobian_scaled, normal_equations
from gnrecon.linalg.damped import Metric
from gnrecon.linalg.gram import BLOCK, gram

seeds = given(seed=st.integers(0, 2**32 - 1))
few = settings(max_examples=8, deadline=None)
each_metric = pytest.mark.parametrize("metric", [identity, jacobian_scaled])


def draw(seed: int, rows: int, size: int) -> tuple[Tensor, Tensor]:
    """A Jacobian with columns of different scales, and a residual."""
    generator = torch.Generator().manual_seed(seed)
    J = torch.randn(rows, size, generator=generator, dtype=torch.float64)
    J *= 10 ** torch.linspace(-1, 1, size, dtype=torch.float64)
    return J, torch.randn(rows, generator=generator, dtype=torch.float64)


def in_chunks(J: Tensor, r: Tensor, size: int) -> Iterator[tuple[Tensor, Tensor]]:
    """Hand out rows in one buffer that is overwritten each time, as the problems do."""
    buffer = torch.empty(size, J.shape[1], dtype=J.dtype)
    for start in range(0, len(J), size):
        rows = J[start : start + size]
        buffer[: len(rows)] = rows
        yield buffer[: len(rows)], r[start : start + size]
        buffer.fill_(torch.nan)


@pytest.mark.parametrize("size", [1, 2, 7, BLOCK - 1, BLOCK, BLOCK + 1, 2 * BLOCK + 3])
@pytest.mark.parametrize("chunk", [1000, 13])
def test_gram(size: int, chunk: int) -> None:
    J, r = draw(size, 50, size)
    product, projected, square = gram(in_chunks(J, r, chunk), size, J)
    torch.testing.assert_close(product.tril(), (J.T @ J).tril())
    torch.testing.assert_close(projected, J.T @ r)
    assert square == pytest.approx(float(r @ r))


def test_gram_keeps_precision_and_takes_no_rows() -> None:
    J, r = draw(0, 9, 4)
    product, projected, _ = gram(in_chunks(J.float(), r.float(), 4), 4, J.float())
    assert product.dtype == projected.dtype == torch.float32
    product, projected, square = gram(iter(()), 4, J)
    assert not bool(product.any())
    assert not bool(projected.any())
    assert square == 0.0


@each_metric
@pytest.mark.parametrize("damping", [1e-3, 1.0, 100.0])
@pytest.mark.parametrize(("rows", "size"), [(60, 11), (11, 11), (7, 20)])
@few
@seeds
def test_step_is_the_stacked_least_squares_solution(
    metric: Metric, damping: float, rows: int, size: int, seed: int
) -> None:
    J, r = draw(seed, rows, size)
    step = normal_equations(in_chunks(J, r, 16), size, J, metric).solve(damping)
    D = torch.ones(size, dtype=J.dtype) if metric is identity else J.square().sum(0)
    stacked = torch.cat([J, torch.diag((damping * D).sqrt())])
    # s minimises |r + J s|^2 + damping |s|_D^2, which is one plain least-squares problem.
    oracle = torch.linalg.lstsq(stacked, torch.cat([-r, r.new_zeros(size)])[:, None], driver="gelsd").solution[:, 0]
    assert step is not None
    torch.testing.assert_close(step.direction, oracle, rtol=1e-7, atol=1e-9 * float(oracle.abs().max()) + 1e-12)
    linear = r + J @ step.direction
    assert step.predicted == pytest.approx(float(r @ r - linear @ linear) / 2, rel=1e-6, abs=1e-10)
    assert step.predicted > 0


@each_metric
def test_one_system_serves_many_dampings(metric: Metric) -> None:
    J, r = draw(1, 40, 9)
    system = normal_equations(in_chunks(J, r, 16), 9, J, metric)
    before = [part.clone() for part in (system.product, system.projected, system.metric)]
    first = system.solve(1e-2)
    longer, shorter = system.solve(1e-4), system.solve(10.0)
    again = system.solve(1e-2)
    assert first is not None
    assert again is not None
    assert longer is not None
    assert shorter is not None
    assert torch.equal(first.direction, again.direction)
    assert longer.predicted > first.predicted > shorter.predicted
    for part, old in zip((system.product, system.projected, system.metric), before, strict=True):
        assert torch.equal(part, old)
    assert system.loss == pytest.approx(0.5 * float(r @ r))


@few
@seeds
def test_marquardts_damping_does_not_depend_on_the_parameters_scales(seed: int) -> None:
    J, r = draw(seed, 30, 8)
    scales = 10 ** torch.linspace(-2, 1, 8, dtype=torch.float64)
    plain = normal_equations([(J, r)], 8, J, jacobian_scaled).solve(0.1)
    scaled = normal_equations([(J * scales, r)], 8, J, jacobian_scaled).solve(0.1)
    assert plain is not None
    assert scaled is not None
    torch.testing.assert_close(scaled.direction * scales, plain.direction)
    assert scaled.predicted == pytest.approx(plain.predicted)


def test_marquardts_damping_bears_a_parameter_that_no_residual_sees() -> None:
    J, r = draw(2, 30, 6)
    J[:, 3] = 0.0
    step = normal_equations([(J, r)], 6, J, jacobian_scaled).solve(1e-3)
    assert step is not None
    assert float(step.direction[3]) == 0.0
    others = [0, 1, 2, 4, 5]
    alone = normal_equations([(J[:, others], r)], 5, J, jacobian_scaled).solve(1e-3)
    assert alone is not None
    torch.testing.assert_close(step.direction[others], alone.direction)


@each_metric
def test_systems_without_a_solution(metric: Metric) -> None:
    J, r = draw(3, 20, 5)
    system = normal_equations([(J, r)], 5, J, metric)
    assert system.solve(1e-3) is not None
    assert system.solve(-1e6) is None, "an indefinite matrix"
    assert system.solve(math.nan) is None
    zero = normal_equations([(J * 0.0, r)], 5, J, metric)
    assert zero.solve(0.0) is None, "a singular matrix"
    for bad in (math.nan, math.inf):
        broken = J.clone()
        broken[4, 2] = bad
        assert normal_equations([(broken, r)], 5, J, metric).solve(1e-3) is None
        wrong = r.clone()
        wrong[7] = bad
        assert normal_equations([(J, wrong)], 5, J, metric).solve(1e-3) is None
