"""The Cholesky factor of one large matrix, block column by block column, in several threads.

A block column is the matrix less the products of the block columns before it; its diagonal block is factored, and the
rows below are divided by that factor. Nearly all of the work are products of matrices. numpy's BLAS computes them at
the full rate of processors of all makers, which torch's own factorisation does not reach on all of them, and threads
share the rows below the diagonal. Where torch has several threads for each product, blocks would not be faster.
Source: Golub and Van Loan, Matrix Computations (2013), section 4.2.
"""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor

from gnrecon.runtime.chunks import slices
from gnrecon.runtime.matrix_product import matmul
from gnrecon.runtime.parallel import map_in_threads


def lower_factor(
    matrix: Tensor, *, least_size: int = 768, block_columns: int = 192, piece_rows: int = 384
) -> Tensor | None:
    """Return L with L L^T = A, its lower triangle valid, or None where A is not positive definite or not finite.

    Parameters
    ----------
    matrix : A, of shape (n, n), its lower triangle valid; it may be overwritten
    least_size : n from which blocks pay; smaller matrices, and those on a GPU, are left to torch
    block_columns : of a block column; large enough for fast products of matrices, and small enough that little is left
        for the factorisation of its diagonal block
    piece_rows : rows below a diagonal block that one thread takes at a time
    """
    if len(matrix) < least_size or matrix.device.type != "cpu" or torch.get_num_threads() > 1:
        factor, failed = torch.linalg.cholesky_ex(matrix)
        return None if int(failed) or not _is_finite(factor) else factor
    for block in slices(len(matrix), block_columns):
        _subtract_products(matrix, block, block)
        diagonal, failed = torch.linalg.cholesky_ex(matrix[block, block])
        if int(failed) or not _is_finite(diagonal):
            return None
        matrix[block, block] = diagonal
        # The pieces do not depend on the number of threads, so that neither does the factor.
        starts = range(block.stop, len(matrix), piece_rows)
        pieces = [slice(start, min(start + piece_rows, len(matrix))) for start in starts]
        map_in_threads(partial(_finish, matrix, block), pieces, brief=True)
    return matrix


def _finish(matrix: Tensor, block: slice, rows: slice) -> None:
    """Make the factor's rows in a block column whose diagonal block L is made: X with X L^T = A."""
    _subtract_products(matrix, block, rows)
    divisor = matrix[block, block].T
    matrix[rows, block] = torch.linalg.solve_triangular(divisor, matrix[rows, block], upper=True, left=False)


def _subtract_products(matrix: Tensor, block: slice, rows: slice) -> None:
    """Subtract from the rows of a block column their products with the block columns before it."""
    before = slice(0, block.start)
    matrix[rows, block] -= matmul(matrix[rows, before], matrix[block, before].T)


def _is_finite(factor: Tensor) -> bool:
    return bool(torch.isfinite(factor.diagonal()).all())
