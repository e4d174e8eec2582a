"""Learns a surface from constraints for ``gnrecon learn``, and reports how well it satisfies them."""

from __future__ import annotations

import json
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from gnrecon.cli.learn_inputs import PAPER_SCANS, DesignFiles, ScanFiles, is_scan, part_mesh, placed
from gnrecon.export import (
    MeshFacts,
    curvatures,
    drop_stray_components,
    require_bordered,
    require_sound,
    verify,
    verify_file,
)
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import Frame
from gnrecon.io import all_input_files, check_writable, write_mesh
from gnrecon.report.report import plain, versions
from gnrecon.runtime.compute_limits import limited
from gnrecon.runtime.errors import ExitCode, UsageError
from gnrecon.runtime.files import atomic_write, one_line, require_files
from gnrecon.runtime.interrupts import ignore_interrupts
from gnrecon.runtime.typed_values import most_threads, require_at_most
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
from gnrecon.shape_learning.design import Design, DesignMeasurement, measure_design


@dataclass(frozen=True)
class LearnOptions:
    """Options of a run; see `gnrecon learn --help`."""

    optimiser: str = "gn"
    budget: float | None = None
    steps: int | None = None
    seed: int = 0
    resolution: int = 192
    curvature: bool = False
    threads: int | None = None
    wider: int = 0

    def __post_init__(self) -> None:
        """Refuse values out of range, before any work."""
        # A thousand units more in each layer are some millions of parameters.
        most = {"steps": 1_000_000, "seed": 2**63 - 1, "resolution": 16_384, "wider": 1000, "threads": most_threads()}
        require_at_most(self, most)
        if self.seed < 0:
            raise UsageError(f"The seed must not be negative, not {self.seed}.")
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
            raise UsageError(f"The number of additional units is {self.wider}, but must be at least 0.")
        if self.wider and self.optimiser != "gn":
            raise UsageError("Additional units (--wider) are for Gauss-Newton only (--optimiser gn).")

    @property
    def seconds(self) -> float | None:
        """The time limit: 600 s where neither it nor steps were given."""
        return 600.0 if self.budget is None and self.steps is None else self.budget


def run_learn(
    name: str,
    output: Path,
    options: LearnOptions,
    *,
    files: DesignFiles,
    scan: ScanFiles | None = None,
    report: Path | None = None,
    overwrite: bool = False,
    quiet: bool = False,
    verbose: bool = False,
    command: str | None = None,
) -> int:
    """Learn a problem's surface, verify and write its mesh, and return the exit code.

    Raises
    ------
    UsageError, FitError, MeshError, OutputError, MemoryLimitError
        Each message is one sentence; nothing is written then.
    """
    scan = scan or ScanFiles()
    _require_consistent(name, files, scan)
    check_writable(output)
    sources = [*files.named(), *([scan.path(name)] if is_scan(name) else [])]
    require_files(all_input_files(sources), [path for path in (output, report) if path is not None], overwrite)
    design = files.read() if name == "bracket" else None
    problem, frame = _problem_and_frame(name, design, files, scan, options.seed)
    console = Console(stderr=True, quiet=quiet)
    # A budget of time makes no same bytes in any case, and a step is one product after the other.
    with limited(options.threads, same_bytes=False):
        learned = learn(
            problem,
            options.optimiser,
            budget=options.seconds,
            steps=options.steps,
            seed=options.seed,
            wider=options.wider,
            callback=(lambda found: _say(console, measurement_text(found))) if verbose else None,
        )
        rng = np.random.default_rng(options.seed)
        if design is None:
            mesh, notes = _mesh(learned, problem, options)
            mesh = mesh if frame is None else placed(mesh, frame)
        else:
            mesh, notes = part_mesh(learned.field, design, options.resolution, options.curvature, rng)
    facts = require_sound(mesh) if design is not None or verify(mesh).closed else require_bordered(mesh)
    design_facts = None if design is None else measure_design(mesh, design, rng)
    values = _report(problem, options, learned, facts, design_facts, command)
    notes += _write(output, report, mesh, values, overwrite)
    if design_facts is not None:
        notes.append(design_facts.describe())
    for sentence in [*notes, learned.solution.status, measurement_text(learned.best), _summary(output, facts)]:
        _say(console, sentence)
    return ExitCode.INTERRUPTED if learned.solution.interrupted else ExitCode.OK


def _require_consistent(name: str, files: DesignFiles, scan: ScanFiles) -> None:
    """Refuse an unknown problem, and files that are not for it."""
    if name not in (*PROBLEMS, "bracket") and not is_scan(name):
        known = ", ".join((*PROBLEMS, "bracket", *PAPER_SCANS))
        raise UsageError(f"There is no problem {name!r}; the problems are {known}, and files of scans.")
    if scan != ScanFiles() and not is_scan(name):
        raise UsageError(f"--share and --data are for scans, not for {name}.")
    if name != "bracket" and files != DesignFiles():
        raise UsageError(f"A design is for the problem bracket only, not for {name}.")


def _problem_and_frame(
    name: str, design: Design | None, files: DesignFiles, scan: ScanFiles, seed: int
) -> tuple[ShapeProblem, Frame | None]:
    """Return a problem, and the frame of its file's coordinates; a part is meshed in its file's coordinates."""
    if design is not None:
        return bracket(design, seed, files.clip), None
    return scan.problem(name, seed) if is_scan(name) else (PROBLEMS[name](), None)


def measurement_text(found: Measurement) -> str:
    """Return a line with the loss and distances of a measurement."""
    shares = ", ".join(f"{name} {share:.1e}" for name, share in found.shares.items())
    distance = "" if found.chamfer is None else f"; Chamfer {found.chamfer:.2e} from the known surface"
    return f"Step {found.step}, {found.seconds:.0f} s: loss {found.loss:.2e} ({shares}){distance}."


def _say(console: Console, sentence: str) -> None:
    console.print(one_line(sentence), highlight=False, markup=False, soft_wrap=True)


def _mesh(learned: Learned, problem: ShapeProblem, options: LearnOptions) -> tuple[Mesh, list[str]]:
    """Return the surface, for a scan without parts that no point supports, and a sentence about what was dropped."""
    mesh = mesh_of(learned.field, problem.shown or problem.box, options.resolution)
    notes: list[str] = []
    if isinstance(problem.known, ScannedSurface):
        mesh, notes = drop_stray_components(mesh, problem.known.points.numpy())
    if not options.curvature:
        return mesh, notes
    mean, gauss = curvatures(learned.field.gradient(mesh.vertices), learned.field.hessian(mesh.vertices))
    return mesh.with_attributes({"mean_curvature": mean, "gauss_curvature": gauss}), notes


def _write(output: Path, report: Path | None, mesh: Mesh, facts: dict[str, Any], overwrite: bool) -> list[str]:
    """Write the mesh and the report; both or neither."""
    bordered = not facts["mesh"]["closed"]

    def verified(path: Path) -> None:
        verify_file(path, bordered)
        ignore_interrupts()

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
    design: DesignMeasurement | None,
    command: str | None,
) -> dict[str, Any]:
    """The report of a run, ready for JSON; losses and Chamfer distances first."""
    history = learned.history
    guarantee = (
        "closed, oriented 2-manifold"
        if facts.closed
        else "oriented edge-manifold with borders: the surface is clipped to its problem's box, and bounds no solid"
    )
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
            "design": None if design is None else design.as_dict(),
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
