"""The parameters by which `auto` estimates the cost of each linear solver."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SolverCostParameters:
    """The cost model of `auto`; one unit of work is a multiply-add at the rate of a large float64 matrix product."""

    # Row space is considered if M is at most this many times p.
    row_space_rows_per_column: float = 0.8
    # One product with J and one with J^T are 2 M p multiply-adds; thin products run at a quarter of the rate.
    iteration_work_per_entry: int = 8
    # Iterations expected with a sampled Gram matrix: fewer early in a fit, more later when the damping is small.
    sampled_iterations: int = 15
    # Rows sampled for the Gram matrix: at least 5/4 per column (see `SampledGram`), and at least so many.
    sampled_rows_per_four_columns: int = 5
    least_sampled_rows: int = 3000
    # Iteration limit of conjugate gradients with Kronecker factors, or with the diagonal.
    layered_iterations: int = 200
    # Such a step is only approximate, so its work counts this many times.
    approximate_step_cost: int = 2
    # A choice stays valid while the numbers of rows and of columns change by less than this factor.
    similar_size_ratio: float = 1.25
