"""The cost model of `auto`: frozen, all of it used, and decisive."""

from __future__ import annotations

from dataclasses import fields, replace

import pytest
import torch
from parameter_checks import assert_frozen, read_attributes

import gnrecon.least_squares
from gnrecon.least_squares import DenseJacobian
from gnrecon.least_squares.auto import Auto, choose
from gnrecon.least_squares.solver_parameters import SolverCostParameters

DEFAULT = SolverCostParameters()


def test_they_are_frozen() -> None:
    assert_frozen(DEFAULT)


def test_each_is_used() -> None:
    assert {field.name for field in fields(DEFAULT)} <= read_attributes(gnrecon.least_squares)


@pytest.mark.parametrize(
    ("rows", "columns", "change", "before", "after"),
    [
        (70, 100, {"row_space_rows_per_column": 0.5}, "Push-through", "Cholesky"),
        (20_000, 2000, {"sampled_iterations": 10**6}, "sampled", "Cholesky"),
        (20_000, 2000, {"least_sampled_rows": 10**6}, "sampled", "Cholesky"),
    ],
)
def test_they_decide(rows: int, columns: int, change: dict[str, float], before: str, after: str) -> None:
    jacobian = DenseJacobian(torch.zeros(1, 1, dtype=torch.float64).expand(rows, columns))
    assert before in choose(jacobian, True, 2**32).solver.describe()
    assert choose(jacobian, True, 2**32).why == choose(jacobian, True, 2**32, parameters=DEFAULT).why
    assert after in choose(jacobian, True, 2**32, parameters=replace(DEFAULT, **change)).solver.describe()


def test_a_choice_is_kept_for_similar_sizes() -> None:
    solver, metric = Auto(), lambda jacobian: torch.ones(jacobian.columns, dtype=torch.float64)
    kept = []
    for rows in (100, 100, int(100 * DEFAULT.similar_size_ratio), int(100 * DEFAULT.similar_size_ratio) + 1):
        solver.linearise(DenseJacobian(torch.ones(rows, 5, dtype=torch.float64)), torch.ones(rows), metric)
        kept.append(solver.choice)
    assert kept[0] is kept[1] is kept[2]
    assert kept[3] is not kept[2]
