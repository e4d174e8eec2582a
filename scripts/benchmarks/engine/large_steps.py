"""Steps of large networks: the push-through (Woodbury) step with and without J, and a step of a million parameters.

The push-through step is  s = -J^T (J J^T + damping I)^-1 r  in float64. *Explicit*: J's rows are written into one
matrix of shape (M, p), then J J^T by a matrix product, a Cholesky factorisation, J^T y. *Ours*:
`gnrecon.least_squares.RowSpace`, whose kernel comes from layer Gram matrices. Each runs in a process of its own, so
that peak memory can be compared; the steps are saved there and compared.

The step of a million parameters on 200,000 rows makes no matrix. Its solver is the one that `--solver auto` chooses,
ended early so that a step takes minutes on two cores. The factors of J's rows would exceed `keep_bytes`, and are
recomputed for each product. The damping is large because it is in units of the mean of J^T J's diagonal, and the
largest eigenvalue of a million is some ten thousand times that: with less, the first steps from random parameters are
rejected (measured at 5,000 rows).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import Any

import torch
from torch import Tensor

from benchmarks.engine.paper_loss import posed, sphere
from benchmarks.harness.measurement import run_isolated, timed
from gnrecon.field import Siren
from gnrecon.fit.objective import FieldProblem
from gnrecon.least_squares import Auto, Iterative, Jacobian, Metric, RowSpace, identity, layer_scaled
from gnrecon.least_squares.system import DampedSystem
from gnrecon.optim import GainRatioDamping, GaussNewton, StopRule


@dataclass(frozen=True)
class KernelSetting:
    """A network, the points of a sphere (two rows each) and of the volume, and the damping."""

    widths: Sequence[int] = (256,) * 5
    points: int = 1500
    volume: int = 1000
    damping: float = 1e-6
    device: str = "cpu"

    @property
    def rows(self) -> int:
        """M."""
        return 2 * self.points + self.volume

    def problem(self) -> FieldProblem:
        """Return the problem, posed at random parameters."""
        field = Siren(tuple(self.widths))
        theta = field.initial(torch.Generator().manual_seed(0)).to(self.device)
        return posed(field, theta, sphere(self.points, self.volume).to(self.device))


def explicit(folder: str, **setting: Any) -> dict[str, Any]:
    """Take the explicit step; leave it in `folder`, and return its seconds."""
    return _measure(explicit_step, Path(folder), KernelSetting(**setting))


def ours(folder: str, **setting: Any) -> dict[str, Any]:
    """Take gnrecon's step; leave it in `folder`, and return its seconds."""
    return _measure(our_step, Path(folder), KernelSetting(**setting))


def explicit_step(problem: FieldProblem, damping: float) -> Tensor:
    """Return s, of shape (p,), by way of J."""
    jacobian, r = problem.linearise(problem.free())
    J, start = torch.empty(jacobian.rows, jacobian.columns, dtype=r.dtype, device=r.device), 0
    for chunk in jacobian.dense():
        J[start : start + len(chunk)] = chunk
        start += len(chunk)
    K = J @ J.T
    K.diagonal().add_(damping)
    factor = torch.linalg.cholesky(K)
    half = torch.linalg.solve_triangular(factor, r[:, None], upper=False)
    y = torch.linalg.solve_triangular(factor.T, half, upper=True)[:, 0]
    step: Tensor = -(J.T @ y)
    return step


def our_step(problem: FieldProblem, damping: float) -> Tensor:
    """Return s, of shape (p,), by way of the kernel.

    Raises
    ------
    RuntimeError
        When there is no step.
    """
    step = RowSpace().linearise(*problem.linearise(problem.free()), identity).solve(damping)
    if step.failure:
        raise RuntimeError(step.failure)
    return step.direction


def _measure(take: Callable[[FieldProblem, float], Tensor], folder: Path, setting: KernelSetting) -> dict[str, Any]:
    # The first use of the libraries is not timed.
    take(KernelSetting((8, 8), 20, 10, setting.damping, setting.device).problem(), setting.damping)
    problem = setting.problem()
    seconds, step = timed(lambda: take(problem, setting.damping), setting.device)
    torch.save(step.cpu(), folder / "step.pt")
    return {"seconds": seconds}


def _isolated(form: str, setting: KernelSetting, folder: Path) -> dict[str, Any]:
    arguments = asdict(setting) | {"folder": str(folder)}
    return run_isolated(f"benchmarks.engine.large_steps:{form}", arguments, folder)


def measure_kernel(setting: KernelSetting, repeat: int, folder: Path) -> dict[str, Any]:
    """Return the medians of both forms' seconds and memory, their ratios, and the steps' relative difference.

    Where a form fails, the sentence under ``"error"`` replaces its figures, and there are no ratios.
    """
    runs: dict[str, list[dict[str, Any]]] = {"explicit": [], "ours": []}
    for number in range(repeat):
        for form, of_form in runs.items():
            of_form.append(_isolated(form, setting, folder / f"{form}-{number}"))
    summary = {form: _median(of_form) for form, of_form in runs.items()}
    parameters = Siren(tuple(setting.widths)).layout.count
    figures = {"setting": asdict(setting), "rows": setting.rows, "parameters": parameters, **summary}
    if any("error" in form for form in summary.values()):
        return figures
    theirs, our = (torch.load(step_file(folder, form)) for form in ("explicit", "ours"))
    return figures | {
        "ratio": summary["explicit"]["seconds"] / summary["ours"]["seconds"],
        "memory_ratio": summary["explicit"]["peak_memory_mb"] / summary["ours"]["peak_memory_mb"],
        "working_memory_ratio": _working(summary["explicit"]) / _working(summary["ours"]),
        "difference": float((our - theirs).norm() / theirs.norm()),
    }


def step_file(folder: Path, form: str = "ours") -> Path:
    """Return where the first run of a form left its step."""
    return folder / f"{form}-0" / "step.pt"


def _median(runs: Sequence[dict[str, Any]]) -> dict[str, Any]:
    failed = [run for run in runs if "error" in run]
    return failed[0] if failed else {key: median(run[key] for run in runs) for key in runs[0]}


def _working(form: dict[str, Any]) -> float:
    """Return the peak memory without that of the libraries, in MB."""
    return max(float(form["peak_memory_mb"] - form["libraries_memory_mb"]), 1e-3)


@dataclass(frozen=True)
class MillionSetting:
    """A network, the points of a sphere (two rows each) and of the volume, the damping, and most iterations a solve."""

    widths: Sequence[int] = (512,) * 5
    points: int = 80_000
    volume: int = 40_000
    damping: float = 1e4
    iterations: int = 5
    keep_bytes: int = 1_500_000_000
    device: str = "cpu"

    @property
    def rows(self) -> int:
        """M."""
        return 2 * self.points + self.volume


@dataclass
class Limited:
    """The solver that `Auto` chooses, ended after so many iterations."""

    iterations: int
    auto: Auto

    def linearise(self, jacobian: Jacobian, residual: torch.Tensor, metric: Metric) -> DampedSystem:
        """Linearise; the limit is read when the system is solved."""
        system = self.auto.linearise(jacobian, residual, metric)
        if self.auto.choice is not None and isinstance(self.auto.choice.solver, Iterative):
            self.auto.choice.solver.limit = self.iterations
        return system

    def describe(self) -> str:
        """Describe the choice."""
        return self.auto.describe()


def million_step(**arguments: Any) -> dict[str, Any]:
    """Take the step; return its seconds, losses and iterations."""
    setting = MillionSetting(**arguments)
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


def measure_million(setting: MillionSetting, folder: Path, *, memory_mb: float = 8000.0) -> dict[str, Any]:
    """Return seconds, losses and memory of the step, or the sentence of its failure under ``"error"``.

    `within_8_gb` is whether the peak was at most `memory_mb`.
    """
    figures = run_isolated("benchmarks.engine.large_steps:million_step", asdict(setting), folder / "million")
    within = {} if "error" in figures else {"within_8_gb": figures["peak_memory_mb"] <= memory_mb}
    parameters = Siren(tuple(setting.widths)).layout.count
    return {"setting": asdict(setting), "rows": setting.rows, "parameters": parameters, **figures, **within}
