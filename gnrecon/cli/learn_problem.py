"""``gnrecon learn PROBLEM -o MESH``: a surface from constraints alone, and how well it keeps to them."""

from __future__ import annotations

import json
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from gnrecon.cli.learn_inputs import FILES, NAME, DesignFiles, ScanFiles, is_scan, part_mesh, placed
from gnrecon.export import MeshFacts, curvatures, drop_stray, require_bordered, require_sound, verify, verify_file
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import Frame
from gnrecon.io import all_input_files, check_writable, write_mesh
from gnrecon.report.report import plain, versions
from gnrecon.runtime.compute_limits import limited
from gnrecon.runtime.errors import ExitCode, UsageError
from gnrecon.runtime.files import atomic_write, require_files
from gnrecon.shape_learning import (
    OPTIMISERS,
    PROBLEMS,
    Learned,
    Measurement,
    ScannedSurface,
    ShapeProblem,
    bracket,
    learn,
    mesh_of,
)
from gnrecon.shape_learning.design import Design, DesignFacts, judge

OPEN = "oriented edge-manifold with borders: the surface is clipped to its problem's box, and bounds no solid"
CLOSED = "closed, oriented 2-manifold"
NO_SCAN = ScanFiles()


@dataclass(frozen=True)
class LearnOptions:
    """What a run may be asked for; see `gnrecon learn --help`."""

    optimiser: str = "gn"
    budget: float | None = None
    steps: int | None = None
    seed: int = 0
    resolution: int = 192
    curvature: bool = False
    threads: int | None = None
    wider: int = 0

    def __post_init__(self) -> None:
        """Refuse what makes no sense, before any work."""
        if self.optimiser not in OPTIMISERS:
            raise UsageError(f"The optimiser is {self.optimiser!r}, but must be one of {', '.join(OPTIMISERS)}.")
        if self.budget is not None and not self.budget > 0:
            raise UsageError(f"The budget is {self.budget:g} s, but must be positive.")
        if self.steps is not None and self.steps < 1:
            raise UsageError(f"The number of steps is {self.steps}, but must be at least 1.")
        if self.resolution < 16:
            raise UsageError(f"The resolution is {self.resolution}, but must be at least 16 cells.")
        if self.threads is not None and self.threads < 1:
            raise UsageError(f"The number of threads is {self.threads}, but must be at least 1.")
        if self.wider < 0:
            raise UsageError(f"The network begins wider by {self.wider} units, but that must be at least 0.")
        if self.wider and self.optimiser != "gn":
            raise UsageError("A network can begin wider by Gauss-Newton alone (--optimiser gn).")

    @property
    def seconds(self) -> float | None:
        """The budget: 600 s where neither it nor steps were asked for."""
        return 600.0 if self.budget is None and self.steps is None else self.budget


def run_learn(
    name: str,
    output: Path,
    options: LearnOptions,
    *,
    files: DesignFiles,
    scan: ScanFiles = NO_SCAN,
    report: Path | None = None,
    overwrite: bool = False,
    quiet: bool = False,
    verbose: bool = False,
    command: str | None = None,
) -> int:
    """Learn a problem's surface, write its mesh once that is verified, and return the exit code.

    Raises
    ------
    UsageError, FitError, MeshError, OutputError, MemoryLimitError
        Each says in one sentence what is wrong; nothing is written then.
    """
    if name not in (*PROBLEMS, NAME) and not is_scan(name):
        known = ", ".join((*PROBLEMS, NAME, *FILES))
        raise UsageError(f"There is no problem {name!r}; the problems are {known}, and files of scans.")
    if scan != NO_SCAN and not is_scan(name):
        raise UsageError(f"A share of points, or a folder of them, is for scans, not for {name}.")
    if name != NAME and files != DesignFiles():
        raise UsageError(f"A design is for the problem {NAME} alone, not for {name}.")
    check_writable(output)
    sources = [*files.named(), *([scan.path(name)] if is_scan(name) else [])]
    require_files(all_input_files(sources), [path for path in (output, report) if path is not None], overwrite)
    design = files.read() if name == NAME else None
    problem, frame = _posed(name, design, files, scan, options.seed)
    console = Console(stderr=True, quiet=quiet)
    with limited(options.threads):
        learned = learn(
            problem,
            options.optimiser,
            budget=options.seconds,
            steps=options.steps,
            seed=options.seed,
            wider=options.wider,
            heard=(lambda found: _say(console, told(found))) if verbose else None,
        )
        rng = np.random.default_rng(options.seed)
        if design is None:
            mesh, notes = _mesh(learned, problem, options)
            mesh = mesh if frame is None else placed(mesh, frame)
        else:
            mesh, notes = part_mesh(learned.field, design, options.resolution, options.curvature, rng)
    facts = require_sound(mesh) if design is not None or verify(mesh).closed else require_bordered(mesh)
    kept = None if design is None else judge(mesh, design, rng)
    said = _report(problem, options, learned, facts, kept, command)
    notes += _write(output, report, mesh, said, overwrite)
    if kept is not None:
        notes.append(kept.describe())
    for sentence in [*notes, learned.solution.status, told(learned.best), _summary(output, facts)]:
        _say(console, sentence)
    return ExitCode.INTERRUPTED if learned.solution.interrupted else ExitCode.OK


def _posed(
    name: str, design: Design | None, files: DesignFiles, scan: ScanFiles, seed: int
) -> tuple[ShapeProblem, Frame | None]:
    """Return a problem, and the frame of its file's coordinates where it has one that is not the part's own."""
    if design is not None:
        return bracket(design, seed, files.clip), None
    return scan.problem(name, seed) if is_scan(name) else (PROBLEMS[name](), None)


def told(found: Measurement) -> str:
    """Return a line about a measurement."""
    shares = ", ".join(f"{name} {share:.1e}" for name, share in found.shares.items())
    distance = "" if found.chamfer is None else f"; Chamfer {found.chamfer:.2e} from the known surface"
    return f"Step {found.step}, {found.seconds:.0f} s: loss {found.loss:.2e} ({shares}){distance}."


def _say(console: Console, sentence: str) -> None:
    console.print(sentence, highlight=False, markup=False, soft_wrap=True)


def _mesh(learned: Learned, problem: ShapeProblem, options: LearnOptions) -> tuple[Mesh, list[str]]:
    """Return the surface, of a scan without what no point holds, and a sentence about what was dropped."""
    mesh = mesh_of(learned.field, problem.shown or problem.box, options.resolution)
    notes: list[str] = []
    if isinstance(problem.known, ScannedSurface):
        mesh, notes = drop_stray(mesh, problem.known.points.numpy())
    if not options.curvature:
        return mesh, notes
    mean, gauss = curvatures(learned.field.gradient(mesh.vertices), learned.field.hessian(mesh.vertices))
    return mesh.with_attributes({"mean_curvature": mean, "gauss_curvature": gauss}), notes


def _write(output: Path, report: Path | None, mesh: Mesh, facts: dict[str, Any], overwrite: bool) -> list[str]:
    """Write the mesh, and with it the report; both or neither."""
    bordered = not facts["mesh"]["closed"]

    def verified(path: Path) -> None:
        verify_file(path, bordered)

    with ExitStack() as stack:
        if report is not None:
            temporary = stack.enter_context(atomic_write(report, overwrite))
            temporary.write_text(json.dumps(facts, indent=2, allow_nan=False) + "\n", encoding="utf-8")
        return write_mesh(mesh, output, overwrite, verify=verified)


def _report(
    problem: ShapeProblem,
    options: LearnOptions,
    learned: Learned,
    facts: MeshFacts,
    kept: DesignFacts | None,
    command: str | None,
) -> dict[str, Any]:
    """All that is known of a run, ready for JSON; losses and Chamfer divergences first."""
    history = learned.history
    guarantee = CLOSED if facts.closed else OPEN
    values: dict[str, Any] = plain(
        {
            "problem": problem.name,
            "command": command,
            "loss": learned.best.loss,
            "chamfer": learned.best.chamfer,
            "loss_history": [found.loss for found in history],
            "chamfer_history": [found.chamfer for found in history],
            "seconds_history": [found.seconds for found in history],
            "step_history": [found.step for found in history],
            "best": learned.best.as_dict(),
            "history": [found.as_dict() for found in history],
            "optimiser": options.optimiser,
            "wider": options.wider,
            "method": learned.solution.method,
            "status": learned.solution.status,
            "interrupted": learned.solution.interrupted,
            "budget": options.seconds,
            "steps": len(learned.solution.history),
            "seconds": learned.seconds,
            "seed": options.seed,
            "network": {
                "widths": problem.network.widths,
                "activation": problem.network.activation.name,
                "parameters": problem.network.layout.count,
            },
            "design": None if kept is None else kept.as_dict(),
            "mesh": {**facts.as_dict(), "guarantee": guarantee},
            "versions": versions(),
        }
    )
    if not facts.closed:
        values["mesh"]["volume"] = None
    return values


def _summary(output: Path, facts: MeshFacts) -> str:
    kind = "closed and manifold" if facts.closed else "open, edge-manifold and oriented"
    return f"{output}: {facts.vertices} vertices, {facts.faces} faces, {kind}, area {facts.area:.6g}."
