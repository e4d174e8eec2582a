"""Products of matrices are those of torch, in each precision, for any number of threads and whatever the layout."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from gnrecon.runtime.matrix_product import matmul
from gnrecon.runtime.parallel import torch_threads


def matrices(dtype: torch.dtype) -> list[tuple[Tensor, Tensor]]:
    """Contiguous and transposed matrices, parts of a matrix, a vector, and what is empty."""
    generator = torch.Generator().manual_seed(0)
    one = torch.randn(40, 7, generator=generator, dtype=torch.float64).to(dtype)
    other = torch.randn(40, 9, generator=generator, dtype=torch.float64).to(dtype)
    return [
        (one, other[:7, :5]),
        (one.T, other),
        (one.T, one),
        (one[:, 2:6], other[::10]),
        (one, other[:7, 0]),
        (one[:, :0], other[:0]),
        (one[:0], one.T),
    ]


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_products(threads: int, dtype: torch.dtype) -> None:
    with torch_threads(threads):
        for left, right in matrices(dtype):
            found = matmul(left, right)
            assert found.dtype == dtype
            wanted = left.double() @ right.double()
            torch.testing.assert_close(found.double(), wanted, rtol=0.0, atol=100 * torch.finfo(dtype).eps)
            found += 1.0  # its memory is its own


@pytest.mark.parametrize("entry", [math.inf, -math.inf, math.nan, 1e300])
def test_numbers_that_are_not_finite_pass_without_a_warning(entry: float) -> None:
    left = torch.ones(3, 4, dtype=torch.float64)
    left[1, 2] = entry
    with torch_threads(1):
        found = matmul(left, left.T)
    torch.testing.assert_close(found, left @ left.T, equal_nan=True)


def test_derivatives_go_through() -> None:
    left, right = torch.eye(3, requires_grad=True), torch.arange(6.0).reshape(3, 2)
    with torch_threads(1):
        matmul(left, right).sum().backward()
    assert left.grad is not None
    torch.testing.assert_close(left.grad, right.sum(1).expand(3, 3))
    with torch_threads(1):
        slopes = torch.func.jacrev(lambda matrix: matmul(matrix, right).sum())(torch.eye(3))
    torch.testing.assert_close(slopes, left.grad)
