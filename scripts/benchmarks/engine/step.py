"""One full step, ours and the baseline's, from the same parameters on the same frozen residuals, alternating.

A step is linearise, solve and search. The baseline takes one; we take several in a row and divide, so that what is set
up once and what is tried in vain are counted as they come. The start is where our own optimiser got in some steps from
random sine features, in the midst of a fit, where both lower the loss. Each side's decrease of the loss goes with its
seconds, because a fast step may be a useless one: `decrease` is 1 - (loss after / loss before)^(1 / steps).
The baseline is timed in two forms: all Jacobian rows at once, which `ratio` is of, and in chunks of CHUNK points, whose
arrays stay in the processor's cache.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

import torch
from torch import Tensor

from benchmarks.engine.baseline import Baseline
from benchmarks.engine.clock import timed
from benchmarks.engine.loss import Sample, posed
from benchmarks.engine.start import solved_start
from gnrecon.field import Siren
from gnrecon.fit.parameters import SingleNetworkParameters
from gnrecon.least_squares import SOLVERS, layer_scaled
from gnrecon.optim import GainRatioDamping, GaussNewton, Solution, StopRule

CHUNK = 512
STEPS = 10
WARM_STEPS, WARM_DAMPING = 5, 1e-2
PRECISION = torch.float32
"""In which the factors of our rows are stored."""


@dataclass(frozen=True)
class Frozen:
    """Where the steps begin: parameters theta, of shape (p,), on a sample, and the damping that our steps had there."""

    widths: tuple[int, ...]
    theta: Tensor
    damping: float
    sample: Sample

    def to(self, device: str) -> Frozen:
        """Return the same on a device."""
        return Frozen(self.widths, self.theta.to(device), self.damping, self.sample.to(device))


def our_steps(frozen: Frozen, steps: int) -> tuple[Solution, str]:
    """Take so many of our steps on the frozen sample; return where they led, and what the solver says of itself."""
    solver = SOLVERS["auto"](SingleNetworkParameters.krylov_tolerance)
    search = GainRatioDamping(initial_damping=frozen.damping, metric=layer_scaled)
    field = Siren(frozen.widths)
    never = StopRule(steps=steps, tolerance=0.0, patience=steps + 1)
    solution = GaussNewton(search, solver).run(
        lambda _, theta: posed(field, theta, frozen.sample, PRECISION), frozen.theta, never
    )
    return solution, solver.describe()


def freeze(widths: tuple[int, ...], sample: Sample, steps: int = WARM_STEPS) -> Frozen:
    """Return where `steps` of our own steps lead."""
    start = Frozen(widths, solved_start(Siren(widths), sample), WARM_DAMPING, sample)
    solution, _ = our_steps(start, steps)
    return Frozen(widths, solution.theta, solution.history[-1].damping, sample)


def measure_step(frozen: Frozen, repeat: int, steps: int = STEPS, device: str = "cpu") -> dict[str, Any]:
    """Return seconds and decreases of both sides, as medians of `repeat` alternating measurements, and `ratio`."""
    here = frozen.to(device)
    sides: dict[str, Callable[[], dict[str, Any]]] = {
        "baseline": lambda: _baseline(here, None, device),
        "baseline_chunked": lambda: _baseline(here, CHUNK, device),
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
    """Return the first run with the median of all seconds; the losses are the same in all."""
    losses = runs[0]["losses"]
    decrease = 1 - (losses[-1] / losses[0]) ** (1 / (len(losses) - 1))
    all_seconds = [run["seconds"] for run in runs]
    return runs[0] | {"seconds": median(all_seconds), "all_seconds": all_seconds, "decrease": decrease}
