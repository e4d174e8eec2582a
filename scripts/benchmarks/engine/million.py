"""One step of a network of a million parameters on 200,000 rows, without any matrix, in a process of its own.

The solver is the one that `--solver auto` chooses, ended early so that a step is a matter of minutes on two cores; the
factors of J's rows would take more than `keep_bytes`, and are made afresh for each product.
The damping is large because it is in units of the mean of J^T J's diagonal, and the largest eigenvalue of a million is
some ten thousand times that: with less, the first steps from random parameters are refused (measured at 5,000 rows).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from benchmarks.engine.clock import timed
from benchmarks.engine.loss import KEEP_BYTES, posed
from benchmarks.engine.process import run_alone
from benchmarks.engine.scans import sphere
from gnrecon.field import Siren
from gnrecon.least_squares import Auto, Iterative, Jacobian, Metric, layer_scaled
from gnrecon.least_squares.system import DampedSystem
from gnrecon.optim import GainRatioDamping, GaussNewton, StopRule

MEMORY_MB = 8000.0
"""What the step may take."""


@dataclass(frozen=True)
class Setting:
    """A network, the points of a sphere (two rows each) and of the volume, the damping, and most iterations a solve."""

    widths: Sequence[int] = (512,) * 5
    points: int = 80_000
    volume: int = 40_000
    damping: float = 1e4
    iterations: int = 5
    keep_bytes: int = KEEP_BYTES
    device: str = "cpu"

    @property
    def rows(self) -> int:
        """M."""
        return 2 * self.points + self.volume


@dataclass
class Limited:
    """What `Auto` chooses, ended after so many iterations."""

    iterations: int
    auto: Auto

    def linearise(self, jacobian: Jacobian, residual: torch.Tensor, metric: Metric) -> DampedSystem:
        """Linearise; the limit is read when the system is solved."""
        system = self.auto.linearise(jacobian, residual, metric)
        if self.auto.choice is not None and isinstance(self.auto.choice.solver, Iterative):
            self.auto.choice.solver.limit = self.iterations
        return system

    def describe(self) -> str:
        """Say what was chosen."""
        return self.auto.describe()


def step(folder: str, **arguments: Any) -> dict[str, Any]:
    """Take the step; return its seconds, losses and iterations."""
    del folder
    setting = Setting(**arguments)
    field = Siren(tuple(setting.widths))
    theta = field.initial(torch.Generator().manual_seed(0)).to(setting.device)
    sample = sphere(setting.points, setting.volume).to(setting.device)
    solver = Limited(setting.iterations, Auto())
    search = GainRatioDamping(initial_damping=setting.damping, metric=layer_scaled)
    seconds, solution = timed(
        lambda: GaussNewton(search, solver).run(
            lambda _, theta: posed(field, theta, sample, torch.float32, setting.keep_bytes), theta, StopRule(steps=1)
        ),
        setting.device,
    )
    record = solution.history[0]
    return {
        "seconds": seconds,
        "losses": [record.before, record.loss],
        "iterations": record.iterations,
        "status": solution.status,
        "solver": solver.describe(),
    }


def measure_million(setting: Setting, folder: Path) -> dict[str, Any]:
    """Return seconds, losses and memory of the step, or the sentence of its failure under ``"error"``."""
    figures = run_alone("benchmarks.engine.million", "step", folder / "million", **asdict(setting))
    within = {} if "error" in figures else {"within_8_gb": figures["peak_memory_mb"] <= MEMORY_MB}
    parameters = Siren(tuple(setting.widths)).layout.count
    return {"setting": asdict(setting), "rows": setting.rows, "parameters": parameters, **figures, **within}
