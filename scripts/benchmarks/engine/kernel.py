"""The push-through (Woodbury) step of a large network, with J written out and with its kernel alone.

Both make  s = -J^T (J J^T + damping I)^-1 r  of the same rows, in float64. *Explicit*: J's rows are written into one
matrix of shape (M, p), then J J^T by a matrix product, a Cholesky factorisation, J^T y. *Ours*: `linalg.RowSpace`,
whose kernel comes from layer Gram matrices. Each runs in a process of its own, so that the peaks of memory are their
own; the steps are left there as files and compared.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import Any

import torch
from torch import Tensor

from benchmarks.engine.clock import timed
from benchmarks.engine.loss import posed
from benchmarks.engine.process import run_alone
from benchmarks.engine.scans import sphere
from gnrecon.field import Siren
from gnrecon.fit.objective import FieldProblem
from gnrecon.least_squares import RowSpace, identity

MODULE = "benchmarks.engine.kernel"
STEP_FILE = "step.pt"


@dataclass(frozen=True)
class Setting:
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
    return _measure(explicit_step, Path(folder), Setting(**setting))


def ours(folder: str, **setting: Any) -> dict[str, Any]:
    """Take our step; leave it in `folder`, and return its seconds."""
    return _measure(our_step, Path(folder), Setting(**setting))


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


def _measure(take: Callable[[FieldProblem, float], Tensor], folder: Path, setting: Setting) -> dict[str, Any]:
    # The libraries' own first use is in nobody's time.
    take(Setting((8, 8), 20, 10, setting.damping, setting.device).problem(), setting.damping)
    problem = setting.problem()
    seconds, step = timed(lambda: take(problem, setting.damping), setting.device)
    torch.save(step.cpu(), folder / STEP_FILE)
    return {"seconds": seconds}


def measure_kernel(setting: Setting, repeat: int, folder: Path) -> dict[str, Any]:
    """Return the medians of both forms' seconds and memory, their ratios, and the steps' relative difference.

    Where a form fails, its sentence stands under ``"error"`` in its place, and there are no ratios.
    """
    runs: dict[str, list[dict[str, Any]]] = {"explicit": [], "ours": []}
    for number in range(repeat):
        for form, of_form in runs.items():
            of_form.append(run_alone(MODULE, form, folder / f"{form}-{number}", **asdict(setting)))
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
    return folder / f"{form}-0" / STEP_FILE


def _median(runs: Sequence[dict[str, Any]]) -> dict[str, Any]:
    failed = [run for run in runs if "error" in run]
    return failed[0] if failed else {key: median(run[key] for run in runs) for key in runs[0]}


def _working(form: dict[str, Any]) -> float:
    """Peak memory without that of the libraries, in MB."""
    return max(float(form["peak_memory_mb"] - form["libraries_memory_mb"]), 1e-3)
