"""The factor of a large matrix against torch's, with any number of threads, and what has no factor."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from gnrecon.least_squares.blocked_cholesky import lower_factor
from gnrecon.runtime.parallel import fixed_sums

SIZES = [0, 1, 191, 767, 768, 961, 1153]
dtypes = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])


def positive(size: int, dtype: torch.dtype) -> Tensor:
    """A positive definite matrix of condition about 100."""
    rows = torch.randn(size + 50, size, generator=torch.Generator().manual_seed(size), dtype=torch.float64)
    matrix: Tensor = rows.T @ rows / max(size, 1) + 0.05 * torch.eye(size, dtype=torch.float64)
    return matrix.to(dtype)


@dtypes
@pytest.mark.parametrize("size", SIZES)
def test_factor_is_that_of_torch_and_the_same_for_any_number_of_threads(size: int, dtype: torch.dtype) -> None:
    matrix = positive(size, dtype)
    wanted = torch.linalg.cholesky(matrix)
    found = []
    for threads in (1, 2, 3):
        with fixed_sums(threads):
            # Only the lower triangle is read.
            factor = lower_factor(matrix.tril() + torch.full_like(matrix, math.nan).triu(1))
        assert factor is not None
        found.append(factor.tril())
    assert torch.equal(found[0], found[1])
    assert torch.equal(found[0], found[2])
    torch.testing.assert_close(found[0], wanted, rtol=0.0, atol=200 * torch.finfo(dtype).eps)


@dtypes
@pytest.mark.parametrize("size", [100, 1000])
@pytest.mark.parametrize("place", [0, 50, -1])
@pytest.mark.parametrize("entry", [-1.0, math.nan, math.inf])
def test_no_factor_of_a_matrix_that_is_not_positive_definite(
    size: int, dtype: torch.dtype, place: int, entry: float
) -> None:
    matrix = positive(size, dtype)
    matrix[place, place] = entry
    with fixed_sums(2):
        assert lower_factor(matrix) is None
