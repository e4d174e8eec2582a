"""Gauss-Newton compared with a plain implementation of the paper's algorithm: time, memory, growth and solvers.

Ratios with a target are at the top level of the report; the figures behind them are under the measurement's name.
Figures of the GPU are under "cuda" with the same names, with relative differences from the processor's results.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from rich.console import Console

from benchmarks.accuracy.scans import BUNNY, ROCKER_ARM
from benchmarks.engine.cost_growth import CostSettings, measure_cost
from benchmarks.engine.large_steps import KernelSetting, MillionSetting, measure_kernel, measure_million, step_file
from benchmarks.engine.our_fit import our_fit
from benchmarks.engine.paper_loss import scan
from benchmarks.engine.plain_baseline import pretrained
from benchmarks.engine.presentation import draw, tables
from benchmarks.engine.step_time import dense_steps, freeze, measure_solvers, measure_step
from benchmarks.engine.time_to_loss import GOALS, measure_quality
from benchmarks.harness import command_line
from gnrecon.runtime.errors import ExitCode, InputError, UsageError


@dataclass(frozen=True)
class Plan:
    """The conditions of all measurements; the defaults are those of the published figures.

    Parameters
    ----------
    data : folder of the paper's shapes
    folder : for the files of processes
    repeat : alternating measurements whose median counts
    budget : most seconds of a baseline's run to a loss
    devices : "cpu", and "cuda" to measure it too
    widths : of the network, where nothing else is said
    kernel, million, cost : networks, rows, dampings and sizes
    kernel_repeat : most repetitions of the push-through step, which takes minutes with J
    dampings : of the solvers
    our_seconds, cost_seconds : most seconds of gnrecon's fits, and of the growths
    """

    data: Path
    folder: Path
    repeat: int = 5
    budget: float = 1500.0
    devices: Sequence[str] = ("cpu",)
    widths: tuple[int, ...] = (32, 32, 32)
    kernel: KernelSetting = field(default_factory=KernelSetting)
    million: MillionSetting = field(default_factory=MillionSetting)
    cost: CostSettings = field(default_factory=CostSettings)
    kernel_repeat: int = 1
    dampings: Sequence[float] = (1e-2, 1e-5)
    our_seconds: float = 100.0
    cost_seconds: float = 600.0


def step(plan: Plan) -> dict[str, Any]:
    """Measure one full step on the scans of the bunny."""
    found: dict[str, Any] = {}
    for name, case in (("bunny_20", "bunny-20"), ("bunny_100", "bunny-100")):
        frozen = freeze(plan.widths, scan(case, plan.data))
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
    theta, fit = pretrained(plan.widths), partial(our_fit, widths=plan.widths)
    for name, goal in GOALS.items():
        sample = scan(goal.case, plan.data)
        compared = measure_quality(goal, sample, plan.widths, fit, theta, (plan.our_seconds, plan.budget))
        found |= {f"time_ratio_{name}": compared["ratio"]}
        found |= {f"time_ratio_{name}_is_lower_bound": compared["is_lower_bound"]}
        found = merged(found, {"quality": {name: compared}})
    return found


def kernels(plan: Plan) -> dict[str, Any]:
    """Measure the push-through step with J and without it."""
    repeat = min(plan.repeat, plan.kernel_repeat)
    on = {
        device: measure_kernel(replace(plan.kernel, device=device), repeat, plan.folder / f"kernel-{device}")
        for device in plan.devices
    }
    found: dict[str, Any] = {"kernel_ratio_5x256": on["cpu"].get("ratio"), "kernel": on["cpu"]}
    if "cuda" not in on:
        return found
    found["cuda"] = {"kernel": on["cuda"]}
    if all("ratio" in of_device for of_device in on.values()):
        here, there = (torch.load(step_file(plan.folder / f"kernel-{device}")) for device in plan.devices)
        found["cuda"]["differences"] = {"kernel step": float((there - here).norm() / here.norm())}
    return found


def large(plan: Plan) -> dict[str, Any]:
    """Measure a step of a million parameters."""
    return {"million": measure_million(plan.million, plan.folder)}


def cost(plan: Plan) -> dict[str, Any]:
    """Measure growth with points and parameters."""
    return {"cost": measure_cost(plan.cost_seconds, plan.cost)}


def solvers(plan: Plan) -> dict[str, Any]:
    """Measure every linear solver."""
    frozen = freeze(plan.widths, scan("bunny-20", plan.data))
    exact = dense_steps(frozen, plan.dampings)
    on = {device: measure_solvers(frozen, exact, plan.dampings, device) for device in plan.devices}
    return {"solvers": on["cpu"]} | ({"cuda": {"solvers": on["cuda"]}} if "cuda" in on else {})


def merged(report: dict[str, Any], more: dict[str, Any]) -> dict[str, Any]:
    """Return both reports; dictionaries under a common name are merged too."""
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


def main(arguments: Sequence[str], plan_of: Callable[..., Plan] = Plan) -> int:
    """Run the benchmark with arguments, at the scale that `plan_of` gives; return the exit code.

    Raises
    ------
    InputError
        When the file of a shape is missing for a named measurement, or cannot be read.
    OutputError
        When a result cannot be written.
    UsageError
        When there is no GPU, or no matplotlib to plot with.
    """
    chosen = _parser().parse_args(arguments)
    _check(chosen)
    # Into a file or a pipe rich would write 80 columns, and truncate figures.
    console = Console(highlight=False, width=None if sys.stdout.isatty() else 120)
    names = chosen.only or _possible(chosen.data, console)
    report: dict[str, Any] = command_line.provenance("engine", arguments) | {"threads": torch.get_num_threads()}
    with command_line.scratch_folder() as folder:
        devices = ("cpu",) if chosen.device == "cpu" else ("cpu", "cuda")
        plan = plan_of(chosen.data, folder, chosen.repeat, chosen.budget, devices)
        for name in names:
            console.print(f"bench: {name}", style="dim")
            report = merged(report, MEASUREMENTS[name](plan))
            # After each one, so that an interrupted run keeps its results.
            command_line.write_report(chosen.json, report)
    for table in tables(report):
        console.print(table)
    if chosen.plot:
        draw(report, chosen.plot)
    return ExitCode.OK


def _parser() -> argparse.ArgumentParser:
    parser = command_line.benchmark_parser("engine", __doc__)
    command_line.add_data(parser, "rocker-arm.off and bun_zipper.ply", "paper")
    parser.add_argument(
        "--only", nargs="+", choices=MEASUREMENTS, help="what to measure (default: all that needs no absent data)"
    )
    parser.add_argument(
        "--repeat", type=int, default=5, metavar="N", help="measurements whose median counts (default: 5)"
    )
    parser.add_argument(
        "--budget", type=float, default=1500.0, metavar="SECONDS", help="most of a baseline's run (default: 1500)"
    )
    parser.add_argument(
        "--device", choices=("cpu", "cuda"), default="cpu", help="cuda: steps, kernel and solvers there too"
    )
    command_line.add_outputs(parser, picture="plot growth and losses", option="--plot")
    return parser


def _check(chosen: argparse.Namespace) -> None:
    """Check the arguments before the work."""
    if chosen.repeat < 1 or not chosen.budget > 0:
        raise UsageError(f"--repeat and --budget must be positive, not {chosen.repeat} and {chosen.budget}.")
    if chosen.device == "cuda" and not torch.cuda.is_available():
        raise UsageError("--device cuda needs a CUDA GPU and a torch built for it; there is none here.")
    command_line.require_drawable(chosen.json, chosen.plot)
    missing = _missing(chosen.data)
    if missing and any(name in NEEDS_DATA for name in chosen.only or ()):
        raise InputError(f"There is no file {missing[0]}; name the folder that holds it with --data.")


def _possible(data: Path, console: Console) -> list[str]:
    missing = _missing(data)
    if missing:
        left_out = ", ".join(NEEDS_DATA)
        console.print(f"bench: there is no file {missing[0]}, so these are left out: {left_out}", soft_wrap=True)
    return [name for name in MEASUREMENTS if not missing or name not in NEEDS_DATA]


def _missing(data: Path) -> list[Path]:
    return [data / shape.file for shape in (ROCKER_ARM, BUNNY) if not (data / shape.file).is_file()]
