"""The measurements by name, each as the entries that it adds to the report.

A ratio that a goal is set for stands at the top of the report, and what it was made from below the measurement's name.
Figures of the GPU stand below "cuda" under the same names, with relative differences to the processor's results.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch

from benchmarks.engine import kernel, million
from benchmarks.engine.baseline import pretrained
from benchmarks.engine.cost import MATMUL, PARAMETERS, POINTS, measure_cost
from benchmarks.engine.ours import WIDTHS, ours
from benchmarks.engine.quality import GOALS, OUR_SECONDS, measure_quality
from benchmarks.engine.scans import scan
from benchmarks.engine.solvers import dense_steps, measure_solvers
from benchmarks.engine.step import freeze, measure_step

STEP_CASES = {"bunny_20": "bunny-20", "bunny_100": "bunny-100"}
SOLVER_CASE = "bunny-20"
KERNEL_REPEAT = 1


@dataclass(frozen=True)
class Plan:
    """What holds for all measurements; the defaults are what the published figures are of.

    Parameters
    ----------
    data : folder of the paper's shapes
    folder : where processes leave their files
    repeat : alternating measurements whose median counts
    budget : most seconds of a baseline's run to a loss
    devices : "cpu", and "cuda" if it is to be measured too
    kernel, million : networks, rows and dampings
    points, parameters : sizes of the growths
    matmul : size of the product that gives the machine's rate
    our_seconds, cost_seconds : most seconds of our fits, and of the growths
    """

    data: Path
    folder: Path
    repeat: int = 5
    budget: float = 1500.0
    devices: Sequence[str] = ("cpu",)
    kernel: kernel.Setting = field(default_factory=kernel.Setting)
    million: million.Setting = field(default_factory=million.Setting)
    points: Sequence[int] = POINTS
    parameters: Sequence[int] = PARAMETERS
    matmul: int = MATMUL
    our_seconds: float = OUR_SECONDS
    cost_seconds: float = 600.0


def step(plan: Plan) -> dict[str, Any]:
    """Measure one full step on the scans of the bunny."""
    found: dict[str, Any] = {}
    for name, case in STEP_CASES.items():
        frozen = freeze(WIDTHS, scan(case, plan.data))
        on = {device: measure_step(frozen, plan.repeat, device=device) for device in plan.devices}
        found = merged(found, {f"step_ratio_{name}": on["cpu"]["ratio"], "step": {name: on["cpu"]}})
        if "cuda" in on:
            here, there = (of_device["ours"]["losses"][1] for of_device in (on["cpu"], on["cuda"]))
            differences = {f"loss after a step, {name}": abs(there / here - 1)}
            found = merged(found, {"cuda": {"step": {name: on["cuda"]}, "differences": differences}})
    return found


def quality(plan: Plan) -> dict[str, Any]:
    """Measure times to a loss on the rocker arm and the bunny."""
    found: dict[str, Any] = {}
    theta = pretrained(WIDTHS)
    for name, goal in GOALS.items():
        sample = scan(goal.case, plan.data)
        compared = measure_quality(goal, sample, WIDTHS, ours, theta, (plan.our_seconds, plan.budget))
        found |= {f"time_ratio_{name}": compared["ratio"]}
        found |= {f"time_ratio_{name}_is_lower_bound": compared["is_lower_bound"]}
        found = merged(found, {"quality": {name: compared}})
    return found


def kernels(plan: Plan) -> dict[str, Any]:
    """Measure the push-through step with J and without it."""
    repeat = min(plan.repeat, KERNEL_REPEAT)
    on = {
        device: kernel.measure_kernel(replace(plan.kernel, device=device), repeat, plan.folder / f"kernel-{device}")
        for device in plan.devices
    }
    found: dict[str, Any] = {"kernel_ratio_5x256": on["cpu"].get("ratio"), "kernel": on["cpu"]}
    if "cuda" not in on:
        return found
    found["cuda"] = {"kernel": on["cuda"]}
    if all("ratio" in of_device for of_device in on.values()):
        here, there = (torch.load(kernel.step_file(plan.folder / f"kernel-{device}")) for device in plan.devices)
        found["cuda"]["differences"] = {"kernel step": float((there - here).norm() / here.norm())}
    return found


def large(plan: Plan) -> dict[str, Any]:
    """Measure a step of a million parameters."""
    return {"million": million.measure_million(plan.million, plan.folder)}


def cost(plan: Plan) -> dict[str, Any]:
    """Measure growth with points and parameters."""
    return {"cost": measure_cost(plan.cost_seconds, plan.points, plan.parameters, plan.matmul)}


def solvers(plan: Plan) -> dict[str, Any]:
    """Measure every linear solver."""
    frozen = freeze(WIDTHS, scan(SOLVER_CASE, plan.data))
    exact = dense_steps(frozen)
    on = {device: measure_solvers(frozen, exact, device=device) for device in plan.devices}
    return {"solvers": on["cpu"]} | ({"cuda": {"solvers": on["cuda"]}} if "cuda" in on else {})


def merged(report: dict[str, Any], more: dict[str, Any]) -> dict[str, Any]:
    """Return both, and where both have a dictionary under a name, both of those."""
    both = {key: (report[key], more[key]) for key in report.keys() & more.keys()}
    nested = {key: merged(a, b) for key, (a, b) in both.items() if isinstance(a, dict) and isinstance(b, dict)}
    return report | more | nested


MEASUREMENTS: dict[str, Callable[[Plan], dict[str, Any]]] = {
    "step": step,
    "quality": quality,
    "kernel": kernels,
    "million": large,
    "cost": cost,
    "solvers": solvers,
}

NEEDS_DATA = ("step", "quality", "solvers")
