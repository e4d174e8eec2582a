"""The commands ``eval``, ``convert``, ``check`` and ``info``, on files, and ``doctor`` and ``schema``, on gnrecon."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gnrecon.cli.shared_parameters import (
    ColumnsOption,
    DebugOption,
    FormatOption,
    OverwriteOption,
    QuietOption,
    SeedOption,
)
from gnrecon.option_table import Panel
from gnrecon.runtime.errors import ExitCode


def eval_command(
    mesh: Annotated[Path, typer.Argument(help="OBJ, PLY, STL, OFF, GLB or 3MF file.")],
    reference: Annotated[Path, typer.Option(help="Mesh or cloud to measure it against.")],
    samples: Annotated[int, typer.Option(help="Points drawn on each surface.")] = 100_000,
    seed: SeedOption = 0,
    report: Annotated[
        Path | None, typer.Option("--json", help="JSON file to write.", rich_help_panel=Panel.OUTPUT)
    ] = None,
    overwrite: OverwriteOption = False,
    debug: DebugOption = False,
) -> None:
    """Print how far a mesh lies from a reference: Chamfer, RMS, Hausdorff, F-score, normal consistency."""
    from gnrecon.cli.inspect_files import evaluate

    del debug
    raise SystemExit(evaluate(mesh, reference, samples=samples, seed=seed, report=report, overwrite=overwrite))


def convert_command(
    source: Annotated[Path, typer.Argument(help="Mesh or cloud to read.")],
    target: Annotated[Path, typer.Argument(help="File to write; its extension names the format.")],
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
    debug: DebugOption = False,
) -> None:
    """Write a mesh or a cloud in another format, unchanged, and name what the format cannot hold."""
    from gnrecon.cli.inspect_files import convert

    del debug
    raise SystemExit(convert(source, target, overwrite=overwrite, quiet=quiet))


def check_command(
    mesh: Annotated[Path, typer.Argument(help="OBJ, PLY, STL, OFF, GLB or 3MF file.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead of text.")] = False,
    debug: DebugOption = False,
) -> None:
    """Check whether a mesh bounds a solid: exit code 0 if it is a closed, oriented 2-manifold, 5 if it is not."""
    from gnrecon.cli.inspect_files import check

    del debug
    raise SystemExit(check(mesh, as_json=as_json))


def info_command(
    scans: Annotated[list[Path], typer.Argument(help="One or more scans; - is standard input.")],
    format: FormatOption = None,
    columns: ColumnsOption = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead of text.")] = False,
    debug: DebugOption = False,
) -> None:
    """Describe a scan, what might make a fit difficult, and what a run would do by default."""
    from gnrecon.cli.scan_info import info

    del debug
    raise SystemExit(info(scans, {} if columns is None else {"columns": columns}, format, as_json=as_json))


def doctor_command() -> None:
    """Check the installation, and print how to install what is missing."""
    from rich.console import Console

    from gnrecon.cli.doctor import diagnose, render

    checks = diagnose()
    render(checks, Console())
    raise SystemExit(0 if all(check.ok for check in checks) else ExitCode.INPUT)


def schema_command() -> None:
    """Print the JSON schema of the report: every field with its meaning and unit."""
    from gnrecon.report.schema import schema_text

    print(schema_text(), end="")
