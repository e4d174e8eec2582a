"""Choosing a solver from the numbers of rows M and parameters p, the memory, and the metric.

Each way has an estimated work for a step, in multiplications with their additions at the rate of a large float64 matrix
product:

    Cholesky      M p^2 / 2 + p^3 / 3                      p^2 numbers, twice
    row space     M^2 w + M^3 / 3                          M^2 numbers, twice; where M <= 0.8 p, D constant on groups
    sampled       m p^2 / 4 + p^3 / 3 + n * 8 M p          p^2 numbers, twice; where m < M, with m = max(5 p / 4, 3000)
    by layers     2 * 200 * 8 M p                          little

The first two are exact; their largest product costs half of it where rows are stored in float32. w is what one entry of
the kernel J J^T costs: 4 (in + out) for each layer, p for a dense J. The product of the sampled rows counts half,
because it serves for more than one step. An iteration of conjugate gradients takes 2 M p, in products so thin that they
run at a quarter of the rate. With a sampled Gram matrix n = 15 iterations are reckoned with at first; early in a fit
there are fewer, late, when the damping is small, more, and once they have cost more than a Cholesky solve for some
time, that one takes over. With Kronecker factors of the layers, or the diagonal where there are no layers, all 200 are
reckoned with, twice, because such a step is only approximate. The least work wins among those that fit the memory; the
last one always does.
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
from gnrecon.least_squares.jacobian import Jacobian, LayeredJacobian
from gnrecon.least_squares.kronecker import Kronecker
from gnrecon.least_squares.preconditioners import Jacobi, SampledGram
from gnrecon.least_squares.system import DampedSystem, LinearSolver, Metric

_log = logging.getLogger(__name__)

FEWER = 0.8
THIN = 8
ITERATIONS_SAMPLED = 15
ITERATIONS_LAYERS = 200
APPROXIMATE = 2
SIMILAR = 1.25


@dataclass(frozen=True)
class Choice:
    """A solver for M rows and p columns, and why, in a sentence."""

    solver: LinearSolver
    why: str
    rows: int
    columns: int
    constant: bool

    def serves(self, jacobian: Jacobian, constant: bool) -> bool:
        """Whether a system is about as large as the one that the choice was made for."""
        similar = all(
            old / SIMILAR <= new <= old * SIMILAR
            for old, new in ((self.rows, jacobian.rows), (self.columns, jacobian.columns))
        )
        return similar and constant == self.constant

    def reconsidered(self, jacobian: Jacobian) -> Choice:
        """Return this choice, or Cholesky where conjugate gradients with sampled rows have cost more of late."""
        solver = self.solver
        if not isinstance(solver, Iterative) or not isinstance(solver.preconditioner, SampledGram):
            return self
        if solver.effort * THIN * jacobian.rows * jacobian.columns < _cholesky_work(jacobian):
            return self
        why = (
            f"Dense normal equations by Cholesky: conjugate gradients with {solver.preconditioner.describe()} took "
            f"{solver.effort:.0f} iterations a step, which cost more."
        )
        return replace(self, solver=Cholesky(), why=why)


@dataclass
class Auto:
    """The solver with the least estimated work; kept, and so its preconditioner, while M and p stay about the same.

    Parameters
    ----------
    energy : at which conjugate gradients stop, see `Iterative`
    memory_bytes : what matrices may take; by default half of a GPU's memory, or a quarter of the machine's
    """

    energy: float = 0.0
    memory_bytes: int | None = None
    choice: Choice | None = field(default=None, init=False, repr=False)

    def linearise(self, jacobian: Jacobian, residual: Tensor, metric: Metric) -> DampedSystem:
        """Choose if need be, and linearise."""
        D = metric(jacobian)
        constant = constant_on_groups(D, jacobian)
        if self.choice is None or not self.choice.serves(jacobian, constant):
            memory = _memory(jacobian.device) if self.memory_bytes is None else self.memory_bytes
            self.choice = choose(jacobian, constant, memory, self.energy)
            _log.info("%s", self.choice.why)
        self.choice = self.choice.reconsidered(jacobian)
        return self.choice.solver.linearise(jacobian, residual, lambda _: D)

    def describe(self) -> str:
        """Say what was chosen, and why."""
        return "The solver with the least estimated work." if self.choice is None else self.choice.why


def choose(jacobian: Jacobian, constant: bool, memory: int, energy: float = 0.0) -> Choice:
    """Return the solver with the least work that fits `memory`, in bytes, given whether D is constant on each group."""
    M, p = jacobian.rows, max(jacobian.columns, 1)
    # Entries of the largest matrix that may be held twice
    fits = memory / (2 * torch.finfo(jacobian.dtype).bits / 8)
    iteration, m = THIN * M * p, max(5 * p // 4, 3000)
    last = Kronecker() if isinstance(jacobian, LayeredJacobian) else Jacobi()
    offers: list[tuple[float, LinearSolver, str]] = []
    if p**2 <= fits:
        why = f"Dense normal equations by Cholesky: {p:,} parameters and {M:,} rows are few enough."
        offers.append((_cholesky_work(jacobian), Cholesky(), why))
    if constant and FEWER * p >= M and fits >= M**2:
        why = f"Push-through in row space: there are fewer rows, {M:,}, than parameters, {p:,}."
        offers.append((M**2 * _entry(jacobian) + M**3 / 3, RowSpace(), why))
    if p**2 <= fits and m < M:
        why = (
            f"CG with a sampled Gram matrix ({m:,} of {M:,} rows): {p:,} parameters are few enough to factorise, "
            f"and there are {M / p:.1f} rows for each."
        )
        work = m * p**2 / 4 + p**3 / 3 + ITERATIONS_SAMPLED * iteration
        offers.append((work, Iterative("cg", SampledGram(m), energy=energy), why))
    why = f"CG with {last.describe()}: {p:,} parameters and {M:,} rows are too many for a factorisation."
    offers.append(
        (
            APPROXIMATE * ITERATIONS_LAYERS * iteration,
            Iterative("cg", last, energy=energy, limit=ITERATIONS_LAYERS),
            why,
        )
    )
    _, solver, why = min(offers, key=lambda offer: offer[0])
    return Choice(solver, why, M, jacobian.columns, constant)


def _cholesky_work(jacobian: Jacobian) -> float:
    M, p = jacobian.rows, jacobian.columns
    return M * p**2 / 2 * (0.5 if jacobian.stored == torch.float32 else 1.0) + p**3 / 3


def _entry(jacobian: Jacobian) -> float:
    """Return what one entry of J J^T costs; in + out of a layer is at least twice the root of its number of columns."""
    if not isinstance(jacobian, LayeredJacobian):
        return jacobian.columns
    return sum(8.0 * math.sqrt(size) for size in jacobian.group_sizes)


def _memory(device: torch.device) -> int:
    # Of all memory and not of what is free at the moment, so that the same input is solved in the same way each time.
    if device.type == "cuda":
        return int(torch.cuda.get_device_properties(device).total_memory) // 2
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 4
