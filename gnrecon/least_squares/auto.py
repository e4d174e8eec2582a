"""Chooses a linear solver by the numbers of rows M and parameters p, the memory, and the metric.

The work of a step is estimated for each solver, in multiply-adds at the rate of a large float64 matrix product:

    Cholesky      M p^2 / 2 + p^3 / 3                      p^2 numbers, twice
    row space     M^2 w + M^3 / 3                          M^2 numbers, twice; if M <= 0.8 p and D is constant on groups
    sampled       m p^2 / 4 + p^3 / 3 + n * 8 M p          p^2 numbers, twice; if m < M, with m = max(5 p / 4, 3000)
    by layers     2 * 200 * 8 M p                          little

The first two are exact; their largest product costs half as much if rows are stored in float32. w is the cost of one
entry of the kernel J J^T: 4 (in + out) for each layer, p for a dense J. The product of the sampled rows counts half,
because it is used for more than one step. An iteration of conjugate gradients takes 2 M p, in thin products that run at
a quarter of the rate. With a sampled Gram matrix n = 15 iterations are assumed. Early in a fit there are fewer; later,
when the damping is small, there are more, and once they cost more than a Cholesky solve, Cholesky replaces them. With
Kronecker factors of the layers, or the diagonal if there are no layers, the limit of 200 iterations is assumed, twice,
because such a step is only approximate. The solver with the least work that fits into memory is chosen; the last one
always fits. The numbers are in `SolverCostParameters`.
"""

from __future__ import annotations

import logging
import math
import os
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from gnrecon.least_squares.direct import Cholesky, RowSpace, constant_on_groups
from gnrecon.least_squares.iterative import Iterative
from gnrecon.least_squares.jacobian import Jacobian
from gnrecon.least_squares.kronecker import Kronecker
from gnrecon.least_squares.layered_jacobian import LayeredJacobian
from gnrecon.least_squares.preconditioners import Jacobi, SampledGram
from gnrecon.least_squares.solver_parameters import SolverCostParameters
from gnrecon.least_squares.system import DampedSystem, LinearSolver, Metric

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class SolverChoice:
    """A solver for M rows and p columns, and the reason for it, in a sentence."""

    solver: LinearSolver
    why: str
    rows: int
    columns: int
    constant: bool
    parameters: SolverCostParameters = SolverCostParameters()

    def serves(self, jacobian: Jacobian, constant: bool) -> bool:
        """Whether a system is about as large as the one that the solver was chosen for."""
        ratio = self.parameters.similar_size_ratio
        similar = all(
            old / ratio <= new <= old * ratio
            for old, new in ((self.rows, jacobian.rows), (self.columns, jacobian.columns))
        )
        return similar and constant == self.constant

    def reconsidered(self, jacobian: Jacobian) -> SolverChoice:
        """Return this choice, or Cholesky if conjugate gradients with sampled rows have cost more in recent steps."""
        solver = self.solver
        if not isinstance(solver, Iterative) or not isinstance(solver.preconditioner, SampledGram):
            return self
        iteration = self.parameters.iteration_work_per_entry
        if solver.effort * iteration * jacobian.rows * jacobian.columns < _cholesky_work(jacobian):
            return self
        why = (
            f"Dense normal equations by Cholesky: conjugate gradients with {solver.preconditioner.describe()} took "
            f"{solver.effort:.0f} iterations a step, which cost more."
        )
        return replace(self, solver=Cholesky(), why=why)


@dataclass
class Auto:
    """The solver with the least estimated work, kept with its preconditioner while M and p stay about the same.

    Parameters
    ----------
    energy : relative error at which conjugate gradients stop, see `Iterative`
    memory_bytes : memory for matrices; by default half of a GPU's memory, or a quarter of the machine's
    """

    energy: float = 0.0
    memory_bytes: int | None = None
    choice: SolverChoice | None = field(default=None, init=False, repr=False)

    def linearise(self, jacobian: Jacobian, residual: Tensor, metric: Metric) -> DampedSystem:
        """Choose a solver if needed, and linearise."""
        D = metric(jacobian)
        constant = constant_on_groups(D, jacobian)
        if self.choice is None or not self.choice.serves(jacobian, constant):
            memory = _memory(jacobian.device) if self.memory_bytes is None else self.memory_bytes
            self.choice = choose(jacobian, constant, memory, self.energy)
            _log.info("%s", self.choice.why)
        self.choice = self.choice.reconsidered(jacobian)
        return self.choice.solver.linearise(jacobian, residual, lambda _: D)

    def describe(self) -> str:
        """Return which solver was chosen, and why."""
        return "The solver with the least estimated work." if self.choice is None else self.choice.why


def choose(
    jacobian: Jacobian,
    constant: bool,
    memory: int,
    energy: float = 0.0,
    parameters: SolverCostParameters = SolverCostParameters(),
) -> SolverChoice:
    """Return the solver with the least work that fits `memory`, in bytes, given whether D is constant on each group."""
    M, p = jacobian.rows, max(jacobian.columns, 1)
    # Entries of the largest matrix of which two fit into memory
    fits = memory / (2 * torch.finfo(jacobian.dtype).bits / 8)
    iteration = parameters.iteration_work_per_entry * M * p
    m = max(parameters.sampled_rows_per_four_columns * p // 4, parameters.least_sampled_rows)
    last = Kronecker() if isinstance(jacobian, LayeredJacobian) else Jacobi()
    candidates: list[tuple[float, LinearSolver, str]] = []
    if p**2 <= fits:
        why = f"Dense normal equations by Cholesky: {p:,} parameters and {M:,} rows are few enough."
        candidates.append((_cholesky_work(jacobian), Cholesky(), why))
    if constant and parameters.row_space_rows_per_column * p >= M and fits >= M**2:
        why = f"Push-through in row space: there are fewer rows, {M:,}, than parameters, {p:,}."
        candidates.append((M**2 * _entry(jacobian) + M**3 / 3, RowSpace(), why))
    if p**2 <= fits and m < M:
        why = (
            f"CG with a sampled Gram matrix ({m:,} of {M:,} rows): {p:,} parameters are few enough to factorise, "
            f"and there are {M / p:.1f} rows for each."
        )
        work = m * p**2 / 4 + p**3 / 3 + parameters.sampled_iterations * iteration
        candidates.append((work, Iterative("cg", SampledGram(m), energy=energy), why))
    why = f"CG with {last.describe()}: {p:,} parameters and {M:,} rows are too many for a factorisation."
    limit = parameters.layered_iterations
    work = parameters.approximate_step_cost * limit * iteration
    candidates.append((work, Iterative("cg", last, energy=energy, limit=limit), why))
    _, solver, why = min(candidates, key=lambda candidate: candidate[0])
    return SolverChoice(solver, why, M, jacobian.columns, constant, parameters)


def _cholesky_work(jacobian: Jacobian) -> float:
    M, p = jacobian.rows, jacobian.columns
    return M * p**2 / 2 * (0.5 if jacobian.stored == torch.float32 else 1.0) + p**3 / 3


def _entry(jacobian: Jacobian) -> float:
    """Return the work for one entry of J J^T; in + out of a layer is at least twice the root of its columns."""
    if not isinstance(jacobian, LayeredJacobian):
        return jacobian.columns
    return sum(8.0 * math.sqrt(size) for size in jacobian.group_sizes)


def _memory(device: torch.device) -> int:
    # Total rather than free memory, so that the same input always gets the same solver.
    if device.type == "cuda":
        return int(torch.cuda.get_device_properties(device).total_memory) // 2
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 4
