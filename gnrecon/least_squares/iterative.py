"""Solves the damped equations by a Krylov method, from products with J and J^T only (matrix-free, as in the paper).

A step solves  (J^T J + damping D) s = -g  at O(M p) per iteration. An iteration needs no set-up, but its preconditioner
does. Gauss-Newton matrices change little from one step to the next, so the preconditioner of one linearisation is
reused for later ones. It is replaced when a solve takes `patience` iterations more than the first solve with it; that
solve then goes on with the new one, so that what it has spent is not lost. It is also reused for similar dampings,
because a few more iterations cost less than a factorisation: with 2,273 parameters and 19,378 rows, ten steps took
0.76 s of CPU time each with one factorisation per damping, and 0.55 s with one for all dampings within a factor of
four. Later, with faster products, a factor of sixteen saved 3 % more, and a patience of 4 in place of 8 another 6 to
11 % (docs/research/2026-11-29-steps-of-large-networks.md).

Products with J may be computed in float32. This solves with J + E, |E| <= eps |J|, and the exact gradient. In the norm
of J^T J + damping D, the step then changes by about |E D^-1/2| / sqrt(damping) of its length. `rounding` bounds this
relative change; if the damping is too small for the bound, J is used in its storage precision.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import torch
from torch import Tensor

from gnrecon.least_squares.jacobian import Jacobian
from gnrecon.least_squares.krylov import Apply, KrylovResult, conjugate_gradients
from gnrecon.least_squares.paper_solvers import gmres
from gnrecon.least_squares.preconditioners import Jacobi, Preconditioner, Prepared
from gnrecon.least_squares.system import Equations, Linearisation, Metric, Step


@dataclass
class CachedPreconditioner:
    """A prepared preconditioner and the iterations that it took.

    Parameters
    ----------
    prepared : the preconditioner
    of : the Jacobian that it was computed from
    like : a gradient of that step, for the number, precision and device of the columns
    first : iterations of the first solve with it, or None before that
    """

    prepared: Prepared
    of: Jacobian
    like: Tensor
    first: int | None = None
    last: tuple[float, Apply] | None = None

    def at(self, damping: float, *, damping_ratio: float = 16.0) -> Apply:
        """Return P^-1 for a damping, or the last one if its damping differs by at most the factor `damping_ratio`.

        Eigenvalues of the preconditioned matrix are wrong by at most that factor.
        """
        if self.last is None or not self.last[0] / damping_ratio <= damping <= self.last[0] * damping_ratio:
            self.last = damping, self.prepared.at(damping)
        return self.last[1]

    def fits(self, gradient: Tensor) -> bool:
        """Whether it can be applied to this vector."""
        like = self.like
        return (like.shape, like.dtype, like.device) == (gradient.shape, gradient.dtype, gradient.device)


@dataclass(frozen=True)
class IterativeSystem(Linearisation):
    """J, never formed, and a preconditioner; the list is empty if there is nothing to solve."""

    solver: Iterative
    kept: list[CachedPreconditioner]

    def solve(self, damping: float, residual: Tensor | None = None) -> Step:
        """Return the step after the iterations that the tolerance or the limit allows."""
        equations = self.equations.at(residual)
        obstacle = equations.obstacle(damping)
        no_descent = "The iterations ended before they found a step that lowers the loss."
        if obstacle or not self.kept:
            return equations.failed(obstacle or no_descent)
        spent, begun, old = 0, None, self.kept[0]
        if old.of is not equations.jacobian:
            result = self._iterate(equations, damping, old, self.solver.patience + (old.first or 0))
            if result.converged:
                return equations.step(result.solution, damping, result.rest, result.iterations)
            spent, self.kept[0] = result.iterations, self.solver.renew(self.equations)
            begun = result if result.failure is None else None
        result = self._iterate(equations, damping, self.kept[0], self.solver.limit, begun)
        if self.kept[0].first is None:
            self.kept[0].first = result.iterations
        spent += result.iterations
        if not result.converged and not float(result.solution @ equations.gradient) < 0.0:
            return equations.failed(result.failure or no_descent, spent)
        return equations.step(result.solution, damping, result.rest, spent)

    @cached_property
    def _rounded(self) -> tuple[Jacobian, float]:
        """J in float32, and the least damping at which its products are accurate enough."""
        squares = _squared_norm(self.equations)
        least = (torch.finfo(torch.float32).eps / self.solver.rounding) ** 2 * squares
        return self.equations.jacobian.rounded(), least

    def _products(self, damping: float) -> Jacobian:
        """Return J in the precision in which the iterations use it."""
        if self.solver.rounding and damping >= self._rounded[1]:
            return self._rounded[0]
        return self.equations.jacobian

    def _iterate(
        self,
        equations: Equations,
        damping: float,
        kept: CachedPreconditioner,
        limit: int,
        begun: KrylovResult | None = None,
    ) -> KrylovResult:
        jacobian, diagonal = self._products(damping), damping * equations.metric

        def apply(v: Tensor) -> Tensor:
            return jacobian.tmv(jacobian.mv(v)).addcmul_(diagonal, v)

        limit = min(limit, self.solver.limit)
        result = self.solver.iterate(apply, -equations.gradient, kept.at(damping), limit, begun)
        self.solver.spent += result.iterations
        return result


def _squared_norm(equations: Equations, *, sampled_rows: int = 64) -> float:
    """Estimate |J D^-1/2|_F^2 from about `sampled_rows` evenly spaced rows."""
    jacobian = equations.jacobian
    rows = torch.arange(0, jacobian.rows, -(-jacobian.rows // sampled_rows), device=jacobian.device)
    squares = sum(float((chunk.square() / equations.metric).sum()) for chunk in jacobian.sample(rows).dense())
    return squares * (jacobian.rows / len(rows))


@dataclass
class Iterative:
    """A Krylov method with a preconditioner that is reused from one linearisation to the next.

    Parameters
    ----------
    method : "cg" or "gmres"
    preconditioner : the approximation of J^T J
    tolerance : |residual of the solve| / |g| at which a solve ends
    energy : conjugate gradients also stop at this relative error of the step in the norm of the damped matrix, as
        measured by the preconditioner; 0.1 is enough for Gauss-Newton, whose model is not more accurate
    limit : most iterations of a solve
    reuse : whether a preconditioner is used for more than one linearisation
    patience : iterations beyond those of its first solve after which an older preconditioner is replaced
    seed : of the preconditioners' random numbers
    rounding : relative change of the step that products with J in float32 may cause, in the norm of the damped matrix;
        0 for products in the storage precision of J
    adapt : returns the preconditioner of the next linearisation from the current one and `effort`; None keeps it
    effort_memory : weight of the previous mean in `effort`
    effort : running mean of the iterations per linearisation
    """

    method: Literal["cg", "gmres"] = "cg"
    preconditioner: Preconditioner = field(default_factory=Jacobi)
    tolerance: float = 1e-6
    energy: float = 0.0
    limit: int = 200
    reuse: bool = True
    patience: int = 4
    seed: int = 0
    rounding: float = 0.0
    adapt: Callable[[Preconditioner, float], Preconditioner] | None = None
    effort_memory: float = 0.7
    kept: CachedPreconditioner | None = field(default=None, init=False, repr=False)
    effort: float = field(default=0.0, init=False, repr=False)
    spent: int = field(default=0, init=False, repr=False)
    generator: torch.Generator = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self.generator = torch.Generator().manual_seed(self.seed)

    def linearise(self, jacobian: Jacobian, residual: Tensor, metric: Metric) -> IterativeSystem:
        """Set up the equations, and a preconditioner unless the last one can be reused."""
        equations = Equations.of(jacobian, residual, metric)
        self.effort, self.spent = self.effort_memory * self.effort + (1 - self.effort_memory) * self.spent, 0
        if self.adapt is not None:
            self.preconditioner = self.adapt(self.preconditioner, self.effort)
        # The obstacles do not depend on the damping, as long as it is positive.
        if equations.obstacle(1.0):
            return IterativeSystem(equations, self, [])
        kept = self.kept
        if kept is None or not self.reuse or not kept.fits(equations.gradient):
            kept = self.renew(equations)
        return IterativeSystem(equations, self, [kept])

    def renew(self, equations: Equations) -> CachedPreconditioner:
        """Set up the preconditioner from a linearisation."""
        prepared = self.preconditioner.prepare(equations.jacobian, equations.metric, self.generator)
        self.kept = CachedPreconditioner(prepared, equations.jacobian, equations.gradient)
        return self.kept

    def iterate(
        self, apply: Apply, right: Tensor, precondition: Apply, limit: int, begun: KrylovResult | None = None
    ) -> KrylovResult:
        """Run the method on  apply(s) = right; conjugate gradients go on from what is begun."""
        if self.method == "gmres":
            return gmres(apply, right, precondition, self.tolerance, limit)
        return conjugate_gradients(apply, right, precondition, self.tolerance, limit, self.energy, begun)

    def describe(self) -> str:
        """Name the method and the preconditioner."""
        name = "GMRES" if self.method == "gmres" else "Conjugate gradients"
        return f"{name}, preconditioned by {self.preconditioner.describe()}."
