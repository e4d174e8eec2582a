"""The engine beside the paper's algorithm written plainly: seconds a step and to a loss, memory, growth, solvers."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from rich.console import Console

from benchmarks.cases import BUNNY, ROCKER_ARM
from benchmarks.engine.measurements import MEASUREMENTS, NEEDS_DATA, Plan, merged
from benchmarks.engine.plot import draw, require_matplotlib
from benchmarks.engine.tables import tables
from benchmarks.paper import DATA
from benchmarks.provenance import provenance
from gnrecon.runtime.errors import ExitCode, InputError, OutputError, UsageError
from gnrecon.runtime.files import write_text

FILE_WIDTH = 120


def main(arguments: Sequence[str], plan_of: Callable[..., Plan] = Plan) -> int:
    """Run the benchmark as the arguments say, at the scale that `plan_of` gives; return the exit code.

    Raises
    ------
    InputError
        When a shape's file is missing for what was named, or cannot be read.
    OutputError
        When a result cannot be written.
    UsageError
        When there is no GPU, or no matplotlib to plot with.
    """
    chosen = _parser().parse_args(arguments)
    _check(chosen)
    # Into a file or a pipe rich would write 80 columns, and cut figures off.
    console = Console(highlight=False, width=None if sys.stdout.isatty() else FILE_WIDTH)
    names = chosen.only or _possible(chosen.data, console)
    report: dict[str, Any] = provenance("engine", arguments) | {"threads": torch.get_num_threads()}
    with TemporaryDirectory(prefix="gnrecon-bench-") as temporary:
        devices = ("cpu",) if chosen.device == "cpu" else ("cpu", "cuda")
        plan = plan_of(chosen.data, Path(temporary), chosen.repeat, chosen.budget, devices)
        for name in names:
            console.print(f"bench: {name}", style="dim")
            report = merged(report, MEASUREMENTS[name](plan))
            # After each one, because the next may be stopped.
            if chosen.json:
                write_text(chosen.json, json.dumps(report, indent=2) + "\n", overwrite=True)
    for table in tables(report):
        console.print(table)
    if chosen.plot:
        draw(report, chosen.plot)
    return ExitCode.OK


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="bench engine", description=__doc__)
    parser.add_argument(
        "--data", type=Path, default=DATA, metavar="DIR", help="folder of rocker-arm.off and bun_zipper.ply"
    )
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
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all numbers; an older file is replaced")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="write a picture (PNG); an older file is replaced")
    return parser


def _check(chosen: argparse.Namespace) -> None:
    """Refuse before the work what would be refused after it."""
    if chosen.repeat < 1 or not chosen.budget > 0:
        raise UsageError(f"--repeat and --budget must be positive, not {chosen.repeat} and {chosen.budget}.")
    if chosen.device == "cuda" and not torch.cuda.is_available():
        raise UsageError("--device cuda needs a CUDA GPU and a torch built for it; there is none here.")
    for file in (chosen.json, chosen.plot):
        if file is not None and not file.absolute().parent.is_dir():
            raise OutputError(f"{file} cannot be written: its folder does not exist.")
    if chosen.plot:
        require_matplotlib()
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
