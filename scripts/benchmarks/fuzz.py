"""Runs damaged and odd scans through whole reconstructions, each in a process of its own, and counts how they end.

Foreseen are a verified mesh and one sentence with an exit code of its own. Exit code 1, a signal, a run that takes too
long or too much memory, a traceback, a warning of a library, a file that a failed run leaves, and a mesh that is not
watertight though its report calls it closed are faults: they are listed, and their scans are kept with ``--keep``. A
fault is made again by ``--first NUMBER --count 1`` with the same seed; Ctrl-C reports the runs so far. One run in ten
is killed at a random moment; its mesh must be whole or absent.
"""

from __future__ import annotations

import json
import shutil
import sys
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.damage import damaged_scan
from benchmarks.harness.command_line import (
    add_outputs,
    benchmark_parser,
    positive,
    provenance,
    require_folders,
    scratch_folder,
    write_report,
)
from gnrecon.batch.child_process import close_fork_servers
from gnrecon.batch.execute import run_child
from gnrecon.batch.job import Limits
from gnrecon.fit.parameters import FitParameters, GlobalFieldParameters, LinearFieldParameters
from gnrecon.runtime.errors import ExitCode
from gnrecon.runtime.interrupts import polite_ends

OPTIONS = (
    (),
    (),
    ("--trim", "3s"),
    ("--orient", "estimate"),
    ("--orient", "signs"),
    ("--smooth-scan", "6s"),
    ("--spacing", "2s"),
    ("--holdout", "0.2"),
    ("--uncertainty", "--curvature"),
    ("--simplify", "0.01"),
    ("--keep-handles",),
)
"""Options of which each run has one choice, besides a fit and a coarse mesh."""

NETWORK = ("--widths", "40", "--steps", "2")
"""The fit of half of the runs; the others have the default fit, most of them with fewer features."""

FASTEST = ("--quality", "draft", "--threads", "1", "--quiet")


@dataclass(frozen=True)
class Run:
    """One run and its end.

    Parameters
    ----------
    number : which, with the seed, makes it again
    scan : name of the file
    options : of the run, besides the fastest ones
    code : exit code, or the negative signal; None where it took too long
    seconds, peak_memory_mb : what it took
    fault : what is wrong with the end, or empty
    killed : whether it was ended at a random moment
    """

    number: int
    scan: str
    options: tuple[str, ...]
    code: int | None
    seconds: float
    peak_memory_mb: float
    fault: str
    killed: bool = False


def prepare() -> None:
    """Import in the process from which runs are forked what they need, and refuse a file that holds nothing.

    The refusal fills what Python keeps of modules, commands and options. It starts no threads, which a fork would lose.
    """
    import laspy  # noqa: F401

    from gnrecon.cli.app import main
    from gnrecon.runtime.preload import preload

    preload()
    with scratch_folder() as folder, suppress(SystemExit):
        (folder / "scan.xyz").touch()
        main([str(folder / "scan.xyz"), "-o", str(folder / "mesh.ply"), *FASTEST])


def work(argument: dict[str, Any]) -> int:
    """Run the command line in a forked process, and return its exit code."""
    import gnrecon.pipeline
    from gnrecon.cli.app import main
    from gnrecon.fit import fit

    if argument["few_features"]:
        vars(gnrecon.pipeline)["fit"] = partial(fit, parameters=FitParameters(global_field=few_features()))
    # The command line hides them from its users; those of the library would see them.
    sys.warnoptions.append("default::RuntimeWarning")
    warnings.simplefilter("ignore")
    warnings.simplefilter("default", RuntimeWarning)
    try:
        main(argument["words"])
    except SystemExit as end:
        return int(end.code or 0)


def few_features() -> GlobalFieldParameters:
    """Return sizes of the global field with which the fit takes the same way in a third of the time."""
    linear = LinearFieldParameters(
        most_units=200, least_units=200, selection_features=120, selection_points=200, selection_volume_samples=400
    )
    return GlobalFieldParameters(linear=linear)


def run_one(number: int, seed: int, folder: Path, limits: Limits, keep: Path | None) -> Run:
    """Make the scan of a number, reconstruct it, and return how that ended."""
    rng = np.random.default_rng([seed, number])
    place = folder / str(number)
    (place / "out").mkdir(parents=True)
    scan = damaged_scan(place, rng)
    fit = NETWORK if rng.random() < 0.5 else ()
    all_features, cells = rng.random() < 0.125, "24" if rng.random() < 0.125 else "16"
    options = ("--resolution", cells, *fit, *OPTIONS[int(rng.integers(0, len(OPTIONS)))])
    mesh = place / "out" / f"mesh{rng.choice(['.ply', '.obj', '.stl', '.glb'])}"
    report = place / "out" / "report.json"
    words = [str(scan), "-o", str(mesh), "--report", str(report), *FASTEST, *options]
    log = place / "log"
    killed = number % 10 == 9
    if killed:
        limits = replace(limits, seconds=float(rng.uniform(0.05, 2.0)))
    end = run_child(
        {"words": words, "few_features": not all_features},
        threads=1,
        log=log,
        environment={},
        limits=limits,
        work="benchmarks.fuzz",
    )
    killed = killed and end.exit_code is None
    if killed:
        fault = "the mesh of a killed run is not whole" if mesh.exists() and not _as_reported(mesh, report) else ""
    else:
        fault = end.message or _fault(end.exit_code, log.read_text("utf-8", "replace"), mesh, report)
    if fault and keep is not None:
        shutil.copytree(place, keep / str(number), dirs_exist_ok=True)
    shutil.rmtree(place)
    return Run(number, scan.name, options, end.exit_code, end.seconds, end.peak_memory_mb, fault, killed)


def _fault(code: int | None, printed: str, mesh: Path, report: Path) -> str:
    """Return what is wrong with the end of a run that kept its limits, or an empty text."""
    lines = printed.splitlines()
    if code == ExitCode.OK:
        if lines:
            return f"printed {lines[-1]}"
        return "" if _as_reported(mesh, report) else "the mesh is not watertight"
    if code not in (ExitCode.INPUT, ExitCode.FIT, ExitCode.MESH, ExitCode.USAGE, ExitCode.MEMORY):
        return f"exit code {code}: {lines[-1] if lines else ''}"
    if len(lines) != 1 or not lines[0].startswith("gnrecon: "):
        return f"printed {len(lines)} lines: {lines[0] if lines else ''}"
    left = sorted(path.name for path in mesh.parent.iterdir())
    return f"left {', '.join(left)}" if left else ""


def _as_reported(mesh: Path, report: Path) -> bool:
    """Whether a mesh is watertight, or its report says that it is open, as one that is trimmed or a single sheet."""
    # A run that is killed may have written the mesh alone.
    return (report.exists() and not json.loads(report.read_text("utf-8"))["mesh"]["closed"]) or _watertight(mesh)


def _watertight(mesh: Path) -> bool:
    import trimesh

    read = trimesh.load_mesh(mesh, process=False)
    # Equal vertices are one, as in STL; trimesh itself merges what is near, which are all of a mesh 1e-20 wide.
    vertices, rows = np.unique(read.vertices, axis=0, return_inverse=True)
    return bool(trimesh.Trimesh(vertices, rows.reshape(-1)[read.faces], process=False).is_watertight)


def runs(numbers: Sequence[int], seed: int, jobs: int, limits: Limits, keep: Path | None = None) -> Iterator[Run]:
    """Yield the runs of some numbers, `jobs` at a time, in their order."""
    try:
        with scratch_folder() as folder, ThreadPoolExecutor(jobs) as pool:
            one = partial(run_one, seed=seed, folder=folder, limits=limits, keep=keep)
            yield from pool.map(one, numbers)
    finally:
        close_fork_servers()


def table(found: Sequence[Run]) -> Table:
    """Return the number of runs for each end, with the time and memory that they took at most."""
    ends = Counter((run.code, run.killed) for run in found)
    made = Table("end", "runs", "longest", "peak memory", title=f"Ends of {len(found)} runs")
    for (code, killed), count in sorted(ends.items(), key=lambda end: (end[0][0] is None, end[0][0] or 0, end[0][1])):
        same = [run for run in found if (run.code, run.killed) == (code, killed)]
        took = f"{max(run.seconds for run in same):.1f} s", f"{max(run.peak_memory_mb for run in same):.0f} MB"
        made.add_row("killed" if killed else _name(code), str(count), *took)
    return made


def _name(code: int | None) -> str:
    if code is None:
        return "too long"
    return f"signal {-code}" if code < 0 else f"exit {code} ({ExitCode(code).name.lower()})"


def main(arguments: Sequence[str]) -> int:
    """Run the benchmark; return 1 where a run ended in a fault."""
    parser = benchmark_parser("fuzz", __doc__)
    parser.add_argument("--count", type=positive, default=300, metavar="N", help="runs (default: 300)")
    parser.add_argument("--first", type=int, default=0, metavar="N", help="number of the first run (default: 0)")
    parser.add_argument("--seed", type=int, default=0, help="seed of all runs (default: 0)")
    parser.add_argument("--jobs", type=positive, default=1, metavar="N", help="runs at a time (default: 1)")
    parser.add_argument("--seconds", type=positive, default=60, metavar="N", help="limit of a run (default: 60)")
    parser.add_argument("--memory", type=positive, default=4000, metavar="MB", help="limit of a run (default: 4000)")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="folder for the scans and logs of faults")
    add_outputs(parser)
    chosen = parser.parse_args(arguments)
    require_folders(chosen.json)
    report = provenance("fuzz", arguments)
    console, found = Console(), list[Run]()
    numbers = range(chosen.first, chosen.first + chosen.count)
    limits = Limits(chosen.seconds, chosen.memory)
    # What was found until an interrupt is reported, too.
    with polite_ends(), suppress(KeyboardInterrupt):
        for run in runs(numbers, chosen.seed, chosen.jobs, limits, chosen.keep):
            found.append(run)
            if run.fault:
                words = " ".join(run.options)
                console.print(
                    f"{run.number} ({run.scan} {words}): {run.fault}", markup=False, highlight=False, soft_wrap=True
                )
            if console.is_terminal and len(found) % 10 == 0:
                print(f"{len(found)} of {chosen.count}", end="\r", file=sys.stderr)
            elif len(found) % 500 == 0:  # a log
                print(f"{len(found)} of {chosen.count}", file=sys.stderr, flush=True)
    console.print(table(found))
    faults = [run for run in found if run.fault]
    console.print(f"{len(faults)} faults.")
    write_report(chosen.json, report | {"runs": [asdict(run) for run in found]})
    return ExitCode.UNFORESEEN if faults else ExitCode.OK
