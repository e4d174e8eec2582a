"""One full step, gnrecon's and the baseline's, from the same parameters on the same points; and every linear solver.

A step is linearise, solve and search. The baseline takes one step; gnrecon takes several in a row, and the time is
divided, so that one-off set-up and rejected trials are included. The start is where gnrecon's optimiser got in a few
steps from random sine features, in the middle of a fit, where both lower the loss. Each side's decrease of the loss is
reported with its seconds, because a fast step may be a useless one: `decrease` is
1 - (loss after / loss before)^(1 / steps). The baseline is timed in two forms: all Jacobian rows at once (`ratio`), and
in chunks whose arrays stay in the processor's cache (`ratio_chunked`).

The solvers are timed on one frozen linearisation at two dampings. The reference is the dense step in float64;
`difference` is |s - s_dense| / |s_dense|. "Set-up" is done once per linearisation, a solve once per damping.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from statistics import median
from typing import Any

import psutil
import torch
from torch import Tensor

from benchmarks.engine.our_fit import solved_start
from benchmarks.engine.paper_loss import Sample, posed
from benchmarks.engine.plain_baseline import Baseline
from benchmarks.harness.measurement import timed
from gnrecon.field import Siren
from gnrecon.fit.parameters import SingleNetworkParameters
from gnrecon.least_squares import SOLVERS, Cholesky, Jacobian, layer_scaled
from gnrecon.optim import GainRatioDamping, GaussNewton, Solution, StopRule
from gnrecon.runtime.parallel import fixed_sums


@dataclass(frozen=True)
class Frozen:
    """Where the steps begin: parameters theta, of shape (p,), a sample, and gnrecon's damping there."""

    widths: tuple[int, ...]
    theta: Tensor
    damping: float
    sample: Sample

    def to(self, device: str) -> Frozen:
        """Return the same on a device."""
        return Frozen(self.widths, self.theta.to(device), self.damping, self.sample.to(device))


def our_steps(frozen: Frozen, steps: int) -> tuple[Solution, str]:
    """Take so many of gnrecon's steps on the frozen sample; return the solution, and the solver's description.

    The factors of the rows are stored in float32, and threads share pieces of work and no sum, as in a fit.
    """
    solver = SOLVERS["auto"](SingleNetworkParameters.krylov_tolerance)
    share = SingleNetworkParameters.least_step_share
    search = GainRatioDamping(initial_damping=frozen.damping, metric=layer_scaled, least_share=share)
    field = Siren(frozen.widths)
    never = StopRule(steps=steps, tolerance=0.0, patience=steps + 1)
    with fixed_sums(None):
        solution = GaussNewton(search, solver).run(
            lambda _, theta: posed(field, theta, frozen.sample, torch.float32), frozen.theta, never
        )
    return solution, solver.describe()


def freeze(widths: tuple[int, ...], sample: Sample, steps: int = 5, *, initial_damping: float = 1e-2) -> Frozen:
    """Return where `steps` of gnrecon's steps lead."""
    start = Frozen(widths, solved_start(Siren(widths), sample), initial_damping, sample)
    solution, _ = our_steps(start, steps)
    return Frozen(widths, solution.theta, solution.history[-1].damping, sample)


def measure_step(
    frozen: Frozen, repeat: int, steps: int = 10, device: str = "cpu", *, chunk: int = 512
) -> dict[str, Any]:
    """Return seconds and decreases of both sides, as medians of `repeat` alternating measurements, and `ratio`.

    gnrecon takes `steps`; the chunked baseline computes its Jacobian for `chunk` points at a time.
    """
    here = frozen.to(device)
    sides: dict[str, Callable[[], dict[str, Any]]] = {
        "baseline": lambda: _baseline(here, None, device),
        "baseline_chunked": lambda: _baseline(here, chunk, device),
        "ours": lambda: _ours(here, steps, device),
    }
    runs: dict[str, list[dict[str, Any]]] = {name: [] for name in sides}
    for _ in range(repeat):
        for name, measure in sides.items():
            runs[name].append(measure())
    summary: dict[str, Any] = {name: _summary(of_side) for name, of_side in runs.items()}
    plain, chunked, ours = (summary[name]["seconds"] for name in sides)
    return {
        "rows": list(frozen.sample.rows),
        "parameters": len(frozen.theta),
        **summary,
        "ratio": plain / ours,
        "ratio_chunked": chunked / ours,
    }


def _baseline(frozen: Frozen, chunk: int | None, device: str) -> dict[str, Any]:
    baseline = Baseline(frozen.widths, frozen.sample, chunk)
    seconds, step = timed(lambda: baseline.step(frozen.theta), device)
    return {"seconds": seconds, "losses": [baseline.loss(frozen.theta), step.loss], "length": step.length}


def _ours(frozen: Frozen, steps: int, device: str) -> dict[str, Any]:
    seconds, (solution, describe) = timed(lambda: our_steps(frozen, steps), device)
    history = solution.history
    return {
        "seconds": seconds / len(history),
        "losses": [history[0].before, *(record.loss for record in history)],
        "dampings": [record.damping for record in history],
        "iterations": [record.iterations for record in history],
        "solver": describe,
    }


def _summary(runs: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the first run with the median of all seconds; the losses of all runs are the same."""
    losses = runs[0]["losses"]
    decrease = 1 - (losses[-1] / losses[0]) ** (1 / (len(losses) - 1))
    all_seconds = [run["seconds"] for run in runs]
    return runs[0] | {"seconds": median(all_seconds), "all_seconds": all_seconds, "decrease": decrease}


def dense_steps(frozen: Frozen, dampings: Sequence[float]) -> list[Tensor]:
    """Return the exact steps, each of shape (p,)."""
    system = Cholesky().linearise(*_linearised(frozen), layer_scaled)
    return [system.solve(damping).direction for damping in dampings]


def measure_solvers(
    frozen: Frozen,
    reference: Sequence[Tensor],
    dampings: Sequence[float],
    device: str = "cpu",
    names: Sequence[str] = tuple(SOLVERS),
) -> dict[str, Any]:
    """Return for each solver its seconds, and for each damping its iterations and difference from the reference.

    A solver whose matrices would take more than half of the memory is skipped, with an error.
    """
    jacobian, residual = _linearised(frozen.to(device))
    return {
        "rows": jacobian.rows,
        "parameters": jacobian.columns,
        "dampings": list(dampings),
        "solvers": {name: _measure(name, jacobian, residual, reference, dampings, device) for name in names},
    }


def _linearised(frozen: Frozen) -> tuple[Jacobian, Tensor]:
    return posed(Siren(frozen.widths), frozen.theta, frozen.sample).linearise(frozen.theta)


def _measure(
    name: str,
    jacobian: Jacobian,
    residual: Tensor,
    reference: Sequence[Tensor],
    dampings: Sequence[float],
    device: str,
) -> dict[str, Any]:
    # The row-space solver holds three M by M matrices of float64 at once.
    needed = 3 * 8 * jacobian.rows**2 if name == "row-space" else 0
    if needed > _memory(device) / 2:
        return {"error": f"It would take {needed / 1e9:.1f} GB."}
    solver = SOLVERS[name]()
    set_up, system = timed(lambda: solver.linearise(jacobian, residual, layer_scaled), device)
    solves = []
    for damping, exact in zip(dampings, reference, strict=True):
        seconds, step = timed(partial(system.solve, damping), device)
        difference = float((step.direction.cpu() - exact).norm() / exact.norm())
        solves.append(
            {"seconds": seconds, "iterations": step.iterations, "difference": difference, "failure": step.failure}
        )
    return {"set_up_seconds": set_up, "describe": solver.describe(), "solves": solves}


def _memory(device: str) -> int:
    if device == "cuda":
        return int(torch.cuda.mem_get_info()[0])
    return int(psutil.virtual_memory().available)
