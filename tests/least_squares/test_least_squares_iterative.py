"""What the iterative solver keeps from one linearisation to the next, and what it does at its limits."""

from __future__ import annotations

from dataclasses import dataclass, field

import pytest
import torch
from damped_problems import F64, PROBLEMS, layered, multiplied_out, randn
from torch import Tensor

from gnrecon.least_squares import (
    DenseJacobian,
    Iterative,
    Jacobi,
    Jacobian,
    LayeredJacobian,
    LayerRows,
    Preconditioner,
    Prepared,
    SampledGram,
    identity,
)
from gnrecon.least_squares.krylov import Apply


@dataclass
class Counting:
    """A preconditioner that remembers how often it was set up and adapted."""

    inner: SampledGram = field(default_factory=lambda: SampledGram(1000))
    prepared: int = 0
    dampings: list[float] = field(default_factory=list)

    def prepare(self, jacobian: Jacobian, metric: Tensor, generator: torch.Generator) -> Prepared:
        """Count a set-up."""
        self.prepared += 1
        made = self.inner.prepare(jacobian, metric, generator)
        counts = self.dampings

        class Adapted:
            def at(self, damping: float) -> Apply:
                counts.append(damping)
                return made.at(damping)

        return Adapted()

    def describe(self) -> str:
        """Name it."""
        return "a counted one"


def system(seed: int, columns: int = 20) -> tuple[DenseJacobian, Tensor]:
    """J and r."""
    generator = torch.Generator().manual_seed(seed)
    return DenseJacobian(randn(generator, 60, columns)), randn(generator, 60)


def test_a_preconditioner_serves_while_the_jacobian_changes_little() -> None:
    counting = Counting()
    solver = Iterative("cg", counting)
    jacobian, r = system(0)
    for step in range(4):
        nearby = DenseJacobian(jacobian.matrix + 1e-3 * step * system(1)[0].matrix)
        made = solver.linearise(nearby, r, identity)
        assert made.solve(1e-2).failure is None
        assert made.solve(1e-3).failure is None
    assert counting.prepared == 1


def test_without_reuse_every_linearisation_prepares() -> None:
    counting = Counting()
    solver = Iterative("cg", counting, reuse=False)
    for _ in range(3):
        solver.linearise(*system(0), identity).solve(1e-2)
    assert counting.prepared == 3


def test_a_preconditioner_can_be_changed_by_how_it_served() -> None:
    efforts = []

    def adapt(preconditioner: Preconditioner, effort: float) -> Preconditioner:
        efforts.append(effort)
        return SampledGram(1000) if effort > 1.0 else preconditioner

    solver = Iterative("cg", Jacobi(), reuse=False, adapt=adapt)
    counts = [solver.linearise(*system(0), identity).solve(1e-2).iterations for _ in range(5)]
    assert efforts[0] == 0.0
    assert efforts[1] == pytest.approx(0.3 * counts[0])
    assert counts[0] > 10
    assert counts[1:] == [1] * 4, "all rows make the exact inverse"


def test_an_old_preconditioner_is_made_anew_when_it_serves_badly() -> None:
    counting = Counting()
    solver = Iterative("cg", counting, patience=3)
    first = solver.linearise(*system(0), identity).solve(1e-2)
    assert counting.prepared == 1
    made = solver.linearise(*system(1), identity)
    second = made.solve(1e-2)
    assert counting.prepared == 2
    assert second.failure is None
    # The iterations with the old one count too, up to where it was given up.
    assert second.iterations == first.iterations + (first.iterations + 3)
    assert made.solve(1e-2).iterations == first.iterations
    assert counting.prepared == 2


def test_other_columns_need_another_preconditioner() -> None:
    counting = Counting()
    solver = Iterative("cg", counting)
    solver.linearise(*system(0), identity).solve(1e-2)
    solver.linearise(*system(0, 15), identity).solve(1e-2)
    jacobian, r = system(0, 15)
    solver.linearise(DenseJacobian(jacobian.matrix.float()), r, identity).solve(1e-2)
    assert counting.prepared == 3


def test_a_solve_that_reached_its_limit_is_a_step() -> None:
    jacobian, r = system(0)
    step = Iterative("cg", Jacobi(), limit=2).linearise(jacobian, r, identity).solve(1e-2)
    assert step.iterations == 2
    assert step.failure is None
    assert step.predicted > 0.0


def test_the_factor_of_a_damping_is_kept() -> None:
    counting = Counting()
    solver = Iterative("cg", counting)
    for _ in range(3):
        made = solver.linearise(*system(0), identity)
        made.solve(1e-2)
        made.solve(1e-2)
    made.solve(1e-1)  # it serves for dampings within a factor of sixteen
    made.solve(1.0)
    assert counting.dampings == [1e-2, 1.0]


@pytest.mark.parametrize("method", ["cg", "gmres"])
def test_truncated_steps_lower_the_loss_as_predicted(method: str) -> None:
    problem = PROBLEMS["network"](3, F64)
    last = 0.0
    for limit in range(1, 8):
        solver = Iterative(method, Jacobi(), limit=limit)  # type: ignore[arg-type]
        step = solver.linearise(problem.jacobian, problem.r, identity).solve(1e-3)
        assert step.failure is None
        assert step.iterations == limit
        linear = problem.r + problem.J @ step.direction
        decrease = float(problem.r @ problem.r - linear @ linear) / 2
        assert step.predicted == pytest.approx(decrease, rel=1e-9)
        assert method != "cg" or decrease > last
        last = decrease


def test_an_empty_system_does_not_disturb_what_is_kept() -> None:
    counting = Counting()
    solver = Iterative("cg", counting)
    solver.linearise(*system(0), identity).solve(1e-2)
    assert (
        solver.linearise(DenseJacobian(torch.zeros(0, 20, dtype=F64)), torch.zeros(0, dtype=F64), identity)
        .solve(1.0)
        .failure
    )
    solver.linearise(*system(0), identity).solve(1e-2)
    assert counting.prepared == 1


def test_the_seed_decides() -> None:
    jacobian, J = layered(4, [(300, True), (200, False)])
    r = randn(torch.Generator().manual_seed(5), len(J))
    steps = [
        Iterative("cg", SampledGram(60), seed=seed, tolerance=1e-3).linearise(jacobian, r, identity).solve(1e-3)
        for seed in (0, 0, 1)
    ]
    assert torch.equal(steps[0].direction, steps[1].direction)
    assert not torch.equal(steps[0].direction, steps[2].direction)


def nearly_dependent(seed: int) -> tuple[LayeredJacobian, Tensor]:
    """Rows whose inputs are nearly the same, and the matrix of them."""
    generator = torch.Generator().manual_seed(seed)
    inputs = 1.0 + randn(generator, 300, 3) * torch.tensor([1.0, 1e-4, 1e-8], dtype=F64)
    rows = LayerRows(randn(generator, 300, 6), inputs)
    return LayeredJacobian(lambda: [[rows]], len(rows), (rows.size,), torch.device("cpu")), multiplied_out(rows)


@pytest.mark.parametrize("damping", [1e-12, 1e-10, 1e-8, 1e-5, 1.0])
def test_rounding_moves_a_step_by_no_more_than_its_share(damping: float) -> None:
    """Products in float32 throughout would move the steps of the three smallest dampings by more."""
    jacobian, J = nearly_dependent(0)
    r = J.mean(1) + 1e-3 * randn(torch.Generator().manual_seed(1), len(J))
    A = J.T @ J + damping * torch.eye(J.shape[1], dtype=F64)
    exact = torch.linalg.solve(A, -J.T @ r)
    solver = Iterative("cg", SampledGram(1000), 1e-13, reuse=False, rounding=0.01)
    error = solver.linearise(jacobian, r, identity).solve(damping).direction - exact
    assert float(error @ A @ error) <= 0.01**2 * float(exact @ A @ exact)


def test_small_dampings_take_the_rows_as_they_are() -> None:
    jacobian, J = layered(0, [(200, 2), (60, 1)], widths=(3, 6, 1))
    r = torch.ones(len(J), dtype=F64)
    system = Iterative("cg", rounding=0.01).linearise(jacobian, r, identity)
    least = (torch.finfo(torch.float32).eps / 0.01) ** 2 * float(J.square().sum())
    assert system._products(1.5 * least).stored == torch.float32
    assert system._products(least / 1.5) is jacobian
    assert Iterative("cg").linearise(jacobian, r, identity)._products(1.0) is jacobian
