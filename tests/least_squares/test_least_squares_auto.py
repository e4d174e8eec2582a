"""What is chosen, and that it is kept; the systems are only described, not solved, where they are large."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
import torch
from damped_problems import F64, randn

from gnrecon.least_squares import (
    Auto,
    Cholesky,
    DenseJacobian,
    Iterative,
    LayeredJacobian,
    RowSpace,
    identity,
    jacobian_scaled,
)
from gnrecon.least_squares.auto import choose

MEMORY = 4 * 2**30


@dataclass(frozen=True)
class Shape(DenseJacobian):
    """A plain Jacobian of a size that is only claimed."""

    size: tuple[int, int] = (0, 0)

    @property
    def rows(self) -> int:
        """M."""
        return self.size[0]

    @property
    def columns(self) -> int:
        """p."""
        return self.size[1]


def plain(rows: int, columns: int) -> Shape:
    """A plain Jacobian."""
    return Shape(torch.zeros(0, dtype=F64), size=(rows, columns))


def network(rows: int, width: int, depth: int) -> LayeredJacobian:
    """A network's Jacobian."""
    sizes = [4 * width, *[width * (width + 1)] * (depth - 1), width + 1]
    return LayeredJacobian(lambda: [], rows, tuple(sizes), torch.device("cpu"))


def described(jacobian: DenseJacobian | LayeredJacobian, constant: bool = True, memory: int = MEMORY) -> str:
    """The solver's own words."""
    return choose(jacobian, constant, memory).solver.describe()


def test_choices_by_size() -> None:
    assert described(network(19_378, 32, 3)).endswith("sampled rows.")
    assert described(network(3_000, 32, 3)).startswith("Dense normal equations")
    assert described(network(400, 32, 3)).startswith("Push-through")
    assert described(network(20_000, 70, 2)).endswith("sampled rows.")
    assert described(network(100_000, 128, 4)).endswith("Kronecker factors of the layers.")
    assert described(plain(100_000, 60_000)).endswith("the diagonal.")
    assert described(plain(30, 4)).startswith("Dense normal equations")


def test_row_space_needs_a_constant_metric_and_memory() -> None:
    jacobian = network(5_000, 128, 4)
    assert described(jacobian).startswith("Push-through")
    assert not described(jacobian, constant=False).startswith("Push-through")
    assert described(jacobian, memory=2**20).endswith("Kronecker factors of the layers.")


@pytest.mark.parametrize(("rows", "columns"), [(0, 0), (0, 5), (5, 0), (1, 1)])
def test_empty_systems_get_some_solver(rows: int, columns: int) -> None:
    assert choose(plain(rows, columns), True, MEMORY).why.endswith(".")


def test_the_reason_has_the_numbers() -> None:
    assert choose(network(19_378, 32, 3), True, MEMORY).why == (
        "CG with a sampled Gram matrix (3,000 of 19,378 rows): 2,273 parameters are few enough to factorise, "
        "and there are 8.5 rows for each."
    )


def test_a_choice_is_kept_while_the_size_stays_about_the_same() -> None:
    generator = torch.Generator().manual_seed(0)
    auto = Auto()
    assert auto.describe()
    kept = []
    for rows in (100, 110, 90, 30, 4):
        auto.linearise(DenseJacobian(randn(generator, rows, 10)), randn(generator, rows), identity)
        assert auto.choice is not None
        kept.append(auto.choice.solver)
    assert kept[0] is kept[1] is kept[2]
    assert kept[2] is not kept[3]
    assert isinstance(kept[3], Cholesky)
    assert isinstance(kept[4], RowSpace)
    jacobian = DenseJacobian(randn(generator, 4, 10))
    assert auto.linearise(jacobian, randn(generator, 4), jacobian_scaled).solve(1e-2).failure is None
    assert auto.choice is not None
    assert isinstance(auto.choice.solver, Cholesky)


def test_little_memory_means_iterations() -> None:
    generator = torch.Generator().manual_seed(1)
    auto = Auto(memory_bytes=0)
    step = auto.linearise(DenseJacobian(randn(generator, 40, 10)), randn(generator, 40), identity).solve(1e-2)
    assert auto.choice is not None
    assert isinstance(auto.choice.solver, Iterative)
    assert step.iterations > 0
