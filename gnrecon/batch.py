"""A folder of scans, each reconstructed in a process of its own, so that a native crash costs one scan only."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table

from gnrecon.atomic import write_text
from gnrecon.errors import ExitCode, InputError, OutputError, UsageError
from gnrecon.io import READERS, WRITERS, extension_of

SUMMARY = "summary.json"


@dataclass(frozen=True)
class Outcome:
    """What became of one scan: exit code 0 and the files, or the code and the sentence that says why not."""

    scan: str
    mesh: str
    report: str
    page: str
    exit_code: int
    message: str
    seconds: float


def run_batch(
    folder: Path,
    output: Path,
    mesh_format: str,
    arguments: Sequence[str],
    *,
    reports: bool = False,
    pages: bool = False,
    quiet: bool = False,
) -> int:
    """Reconstruct every readable file of `folder` into `output` and return the exit code.

    A JSON summary is written beside the meshes.

    Parameters
    ----------
    folder : where the scans are; subfolders are not entered
    output : made when missing
    mesh_format : extension of the meshes, without the dot
    arguments : passed on to ``gnrecon reconstruct``
    reports : whether a JSON report is written beside each mesh, under its name with ``.report.json``
    pages : whether a page is written beside each mesh, under its name with ``.html``

    Raises
    ------
    InputError
        When the folder is missing or holds no scan.
    UsageError
        When the format is unknown, or two scans would give one mesh.
    OutputError
        When the output folder cannot be made.
    """
    if f".{mesh_format}" not in WRITERS:
        raise UsageError(f"Meshes cannot be written as {mesh_format!r}; use {', '.join(s[1:] for s in WRITERS)}.")
    scans = _scans(folder)
    targets = _targets(scans, output, mesh_format)
    _make(output)
    console = Console(stderr=True, quiet=quiet)
    outcomes: list[Outcome] = []
    interrupted = False
    try:
        for number, (scan, target) in enumerate(zip(scans, targets, strict=True), 1):
            console.print(f"[{number}/{len(scans)}] {scan}", highlight=False, markup=False)
            outcomes.append(_one(scan, target, arguments, reports, pages))
            interrupted = outcomes[-1].exit_code == ExitCode.INTERRUPTED
            if interrupted:
                break
    except KeyboardInterrupt:  # What was done until now is still worth its summary.
        interrupted = True
    summary = {"failed": sum(o.exit_code != 0 for o in outcomes), "scans": [asdict(o) for o in outcomes]}
    write_text(output / SUMMARY, json.dumps(summary, indent=2) + "\n", overwrite=True)
    console.print(_table(outcomes))
    if interrupted:
        print(f"gnrecon: Interrupted; {output / SUMMARY} tells what was done until then.", file=sys.stderr)
        return ExitCode.INTERRUPTED
    return ExitCode.BATCH if summary["failed"] else ExitCode.OK


def _scans(folder: Path) -> list[Path]:
    if not folder.is_dir():
        raise InputError(f"There is no folder {folder}.")
    scans = sorted(path for path in folder.iterdir() if extension_of(path) in READERS and path.is_file())
    if not scans:
        raise InputError(f"The folder {folder} holds no scan; extensions read are {', '.join(READERS)}.")
    return scans


def _targets(scans: Sequence[Path], output: Path, mesh_format: str) -> list[Path]:
    """Name the meshes after their scans; two scans of one name are told apart by their extensions."""
    stems = [scan.stem for scan in scans]
    names = [scan.stem if stems.count(scan.stem) == 1 else scan.name for scan in scans]
    targets = [output / f"{name}.{mesh_format}" for name in names]
    for scan, target in zip(scans, targets, strict=True):
        if target.exists() and target.samefile(scan):
            raise UsageError(f"{target} is a scan itself; choose another folder for the meshes.")
    return targets


def _make(output: Path) -> None:
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"The folder {output} cannot be made: {error.strerror or error}.") from error


def _one(scan: Path, target: Path, arguments: Sequence[str], reports: bool, pages: bool) -> Outcome:
    """Run one scan; its last line on stderr is the sentence to report."""
    report = str(target.with_suffix(".report.json")) if reports else ""
    page = str(target.with_suffix(".html")) if pages else ""
    command = [sys.executable, "-m", "gnrecon", "reconstruct", str(scan), "-o", str(target), "--quiet", *arguments]
    command += ["--report", report] if reports else []
    command += ["--html", page] if pages else []
    start = time.perf_counter()
    # No standard input, and output by pipe: nothing of one scan can end up in the batch's own streams.
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False)
    seconds = round(time.perf_counter() - start, 2)
    lines = done.stderr.strip().splitlines()
    message = lines[-1].removeprefix("gnrecon: ") if lines and done.returncode else ""
    if done.returncode < 0:
        message = f"Killed by {signal.Signals(-done.returncode).name}."
    files = (str(target), report, page) if done.returncode == 0 else ("", "", "")
    return Outcome(str(scan), *files, done.returncode, message, seconds)


def _table(outcomes: Sequence[Outcome]) -> Table:
    failed = sum(outcome.exit_code != 0 for outcome in outcomes)
    table = Table(title=f"{len(outcomes) - failed} of {len(outcomes)} scans reconstructed", title_justify="left")
    for heading in ("scan", "exit", "seconds", "result"):
        table.add_column(heading, overflow="fold")
    for outcome in outcomes:
        result = outcome.mesh or outcome.message
        table.add_row(outcome.scan, str(outcome.exit_code), f"{outcome.seconds:.1f}", result)
    return table
