"""J^T J from chunks of rows, against the dense product."""

from __future__ import annotations

import inspect
from collections.abc import Iterator

import pytest
import torch
from damped_problems import randn
from torch import Tensor

from gnrecon.least_squares.layer_products import gram


def in_chunks(J: Tensor, size: int) -> Iterator[Tensor]:
    """Hand out rows in one buffer that is overwritten each time, as the Jacobians do."""
    buffer = torch.empty(size, J.shape[1], dtype=J.dtype)
    for start in range(0, len(J), size):
        rows = J[start : start + size]
        buffer[: len(rows)] = rows
        yield buffer[: len(rows)]
        buffer.fill_(torch.nan)


BLOCK = inspect.signature(gram).parameters["block_columns"].default


@pytest.mark.parametrize("size", [0, 1, 2, 7, BLOCK - 1, BLOCK, BLOCK + 1, 2 * BLOCK + 3])
@pytest.mark.parametrize("chunk", [1000, 13])
def test_gram(size: int, chunk: int) -> None:
    J = randn(torch.Generator().manual_seed(size), 50, size)
    product = gram(in_chunks(J, chunk), size, J)
    torch.testing.assert_close(product.tril(), (J.T @ J).tril())


def test_gram_sums_float32_products_in_float64() -> None:
    J = randn(torch.Generator().manual_seed(0), 50, 9)
    product = gram(in_chunks(J.float(), 4), 9, J)
    assert product.dtype == torch.float64
    torch.testing.assert_close(product.tril(), (J.T @ J).tril(), rtol=1e-5, atol=1e-5)
    # One row after the other: what float32 sums would lose, float64 sums keep.
    many = torch.full((2**13, 1), 1.0, dtype=torch.float32)
    many[0] = 2.0**13
    assert float(gram(in_chunks(many, 1), 1, J)[0, 0]) == 2.0**26 + 2**13 - 1


def test_gram_of_no_rows_is_zero() -> None:
    like = torch.zeros(0)
    product = gram(iter(()), 4, like)
    assert product.shape == (4, 4)
    assert product.dtype == like.dtype
    assert not bool(product.any())
