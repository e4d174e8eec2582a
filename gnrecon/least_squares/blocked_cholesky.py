"""The Cholesky factor of one large matrix, block column by block column, in several threads.

A block column is the matrix less the products of the block columns before it; its diagonal block is factored, and the
rows below are divided by that factor. Nearly all of the work are products of matrices. numpy's BLAS computes them at
the full rate of processors of all makers, which torch's own factorisation does not reach on all of them, and threads
share the rows below the diagonal. Where torch has several threads for each product, blocks would not be faster.
Source: Golub and Van Loan, Matrix Computations (2013), section 4.2.
"""

from __future__ import annotations

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
        before = slice(0, block.start)
        _subtract_product(matrix, block, block, before)
        diagonal, failed = torch.linalg.cholesky_ex(matrix[block, block])
        if int(failed) or not _is_finite(diagonal):
            return None
        matrix[block, block] = diagonal

        def divide(rows: slice, block: slice = block, before: slice = before, divisor: Tensor = diagonal.T) -> None:
            _subtract_product(matrix, rows, block, before)
            # X L^T = A for the factor L of the diagonal block
            matrix[rows, block] = torch.linalg.solve_triangular(divisor, matrix[rows, block], upper=True, left=False)

        below = slices(len(matrix) - block.stop, piece_rows)
        # The rows of a piece do not depend on the number of threads, so that neither does the factor.
        pieces = [slice(block.stop + rows.start, block.stop + rows.stop) for rows in below]
        map_in_threads(divide, pieces, brief=True)
    return matrix


def _subtract_product(matrix: Tensor, rows: slice, columns: slice, before: slice) -> None:
    """Subtract from the rows of a block column the product of these rows with those of the diagonal block."""
    matrix[rows, columns] -= matmul(matrix[rows, before], matrix[columns, before].T)


def _is_finite(factor: Tensor) -> bool:
    return bool(torch.isfinite(factor.diagonal()).all())
