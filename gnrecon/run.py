"""Runs one reconstruction for the command line as a transaction.

Invalid arguments are refused before any work, a progress bar shows the stages, and all files are written or none.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, nullcontext
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    ProgressColumn,
    SpinnerColumn,
    Task,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
)
from rich.text import Text

from gnrecon.config import settings_text
from gnrecon.io import written_origin
from gnrecon.io.run_files import Files
from gnrecon.optim import Record
from gnrecon.pipeline import Progress as PipelineProgress
from gnrecon.pipeline import Reconstruction, reconstruct
from gnrecon.rendering import render, render_sheet
from gnrecon.report.html import page_text
from gnrecon.report.time_left import TimeLeft
from gnrecon.runtime.errors import ExitCode
from gnrecon.runtime.files import atomic_write, one_line, printable
from gnrecon.runtime.interrupts import ignore_interrupts
from gnrecon.runtime.logs import logged

STAGES = {
    "read": "Reading",
    "ingest": "Cleaning",
    "fit": "Fitting",
    "extract": "Extracting",
    "project": "Projecting",
    "refine": "Refining",
    "repair": "Repairing",
    "offset": "Offsetting",
    "cut": "Cutting",
    "trim": "Trimming",
    "verify": "Verifying",
    "attributes": "Carrying",
    "measure": "Measuring",
    "write": "Writing",
}


def run(
    files: Files,
    options: dict[str, Any],
    *,
    command: str | None = None,
    quiet: bool = False,
    verbose: bool = False,
    log: Path | None = None,
    watcher: PipelineProgress | None = None,
) -> int:
    """Reconstruct one scan and return the exit code.

    Parameters
    ----------
    files : what is read and written, checked by `Files.check`
    options : how, see `Options`
    command : the command line, for the report
    quiet, verbose : print failures only; print choices, counts, stages and steps
    log : file to append the library's log to
    watcher : receives stages and steps instead of the progress bar

    Raises
    ------
    GnreconError
        From any stage; nothing is written then.
    """
    console = Console(stderr=True, quiet=quiet)
    bar = progress_bar(console, verbose) if watcher is None else nullcontext(watcher)
    with logged(console if verbose else None, log, files.named), bar as progress:
        result = reconstruct(files.scans, reference=files.reference, format=files.format, progress=progress, **options)
        result.report["command"] = command
        progress.stage("write")
        warnings = _write(files, result)
    summary = summarise(files.output, result.report["mesh"], result.report["resources"])
    for sentence in [*warnings, summary]:
        console.print(one_line(sentence), highlight=False, markup=False, soft_wrap=True)
    if result.metrics is not None:
        print("\n".join(result.metrics.describe()))
    if result.interrupted:
        print(
            f"gnrecon: Interrupted; {one_line(str(files.output))} is the mesh of the best field so far.",
            file=console.file,
        )
        return ExitCode.INTERRUPTED
    return ExitCode.OK


def _write(files: Files, result: Reconstruction, *, thumbnail_pixels: tuple[int, int] = (240, 180)) -> list[str]:
    """Write the mesh and the side files, all of them or none; an overview of a batch shows the thumbnail."""
    origin = written_origin(result.mesh, files.output)
    result.report["origin"] = None if origin is None else origin.tolist()
    with ExitStack() as stack:
        # Side files are complete under temporary names before the mesh gets its name.
        if files.report is not None:
            report = stack.enter_context(atomic_write(files.report, files.overwrite))
            report.write_text(json.dumps(result.report, indent=2, allow_nan=False) + "\n", encoding="utf-8")
        if files.preview is not None:
            picture = stack.enter_context(atomic_write(files.preview, files.overwrite))
            render_sheet(result.mesh, picture, points=result.cloud)
        if files.thumbnail is not None:
            small = stack.enter_context(atomic_write(files.thumbnail, files.overwrite))
            render(result.mesh, small, size=thumbnail_pixels)
        if files.model is not None:
            model = stack.enter_context(atomic_write(files.model, files.overwrite))
            result.sdf.save(model, overwrite=True)
        if files.config is not None:
            config = stack.enter_context(atomic_write(files.config, files.overwrite))
            values = {**result.report["options"], "reference": files.reference}
            config.write_text(settings_text(values, files.scans[0]), encoding="utf-8")
        if files.html is not None:
            page = stack.enter_context(atomic_write(files.html, files.overwrite))
            page.write_text(printable(page_text(result.report, result.mesh, result.cloud)), encoding="utf-8")
        # From here on, an interrupt would leave the mesh without its side files, or say that nothing was written.
        return result.save(files.output, files.overwrite, complete=ignore_interrupts)


def summarise(output: Path, facts: Mapping[str, Any], resources: Mapping[str, Any]) -> str:
    """Return a line about a written mesh, from the mesh facts and resources of the report."""
    if facts["closed"]:
        kind = f"genus {facts['genus']}, closed and manifold, volume {facts['volume']:.6g}"
    else:
        kind = f"open, edge-manifold and oriented, area {facts['area']:.6g}"
    return (
        f"{output}: {facts['vertices']} vertices, {facts['faces']} faces, {facts['components']} component"
        f"{'s' if facts['components'] != 1 else ''}, {kind}; "
        f"{resources['seconds']:.1f} s, {resources['peak_memory_mb']:.0f} MB."
    )


class _TimeLeftColumn(ProgressColumn):
    """The time to the end of the run, not only of the stage."""

    def __init__(self, left: TimeLeft) -> None:
        super().__init__()
        self._left = left

    def render(self, task: Task) -> Text:
        """Return the time as text."""
        del task
        return Text(self._left.describe(), style="progress.remaining")


class ConsoleProgress(PipelineProgress):
    """Shows stages, steps, remarks and the time left on a console."""

    def __init__(self, console: Console, bar: Progress, verbose: bool, left: TimeLeft) -> None:
        self._console, self._bar, self._verbose, self._left = console, bar, verbose, left
        self._task: TaskID | None = None

    def stage(self, name: str) -> None:
        """Start a bar for a stage."""
        self._left.stage(name)
        if self._task is not None:
            self._bar.remove_task(self._task)
        self._task = self._bar.add_task(STAGES[name], total=None, detail="")

    def advance(self, share: float) -> None:
        """Fill the bar up to a share of the stage."""
        self._left.advance(share)
        if self._task is not None:
            self._bar.update(self._task, completed=share, total=1.0)

    def expect(self, fit_seconds: float, mesh_seconds: float) -> None:
        """Show the time left from now on."""
        self._left.expect(fit_seconds, mesh_seconds)

    def step(self, record: Record, total: int) -> None:
        """Show a step's loss, damping and gain ratio."""
        detail = f"loss {record.loss:.3e}  damping {record.damping:.1e}  gain {record.gain_ratio:.2f}"
        if self._task is not None:
            self._bar.update(self._task, detail=detail)
        if self._verbose:
            self._console.print(
                f"step {record.step:4d}/{total}  {detail}", highlight=False, markup=False, soft_wrap=True
            )

    def remark(self, sentence: str) -> None:
        """Print a sentence above the bar."""
        self._console.print(one_line(sentence), highlight=False, markup=False, soft_wrap=True)


@contextmanager
def progress_bar(console: Console, verbose: bool) -> Iterator[ConsoleProgress]:
    """Show a progress bar on a terminal while the block runs, and yield the callbacks that fill it."""
    left = TimeLeft()
    columns = (
        SpinnerColumn(),
        TextColumn("{task.description:10}"),
        BarColumn(bar_width=24),
        TextColumn("{task.fields[detail]}"),
        TimeElapsedColumn(),
        _TimeLeftColumn(left),
    )
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        yield ConsoleProgress(console, bar, verbose, left)
