"""The command ``gnrecon reconstruct SCAN -o MESH``, which is the default command."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from gnrecon.cli.command_classes import HelpAllOption
from gnrecon.cli.option_parameters import given_options, with_table_options
from gnrecon.cli.shared_parameters import (
    ConfigOption,
    DebugOption,
    FormatOption,
    MemoryOption,
    OutputOption,
    OverwriteOption,
    QuietOption,
    SetOption,
)
from gnrecon.cli.supervision import continue_in_child
from gnrecon.option_table import Panel
from gnrecon.runtime.typed_values import parse_megabytes

ScansArgument = Annotated[
    list[Path],
    typer.Argument(
        help="One or more scans of an object, merged by the poses that they hold: PLY, PCD, XYZ, PTS, TXT, CSV, "
        "LAS, LAZ, E57, PTX, VTK, VTP, VTU, VTS, OBJ, OFF, STL, glTF, GLB or 3MF, compressed by gzip or not; CONF "
        "names scans with their poses; - is standard input."
    ),
]
ReferenceOption = Annotated[
    Path | None,
    typer.Option(
        help="Mesh or cloud to measure the result against; distances are printed to stdout.",
        rich_help_panel=Panel.OUTPUT,
    ),
]
ReportOption = Annotated[Path | None, typer.Option(help="JSON report to write.", rich_help_panel=Panel.OUTPUT)]
PreviewOption = Annotated[
    Path | None,
    typer.Option(help="PNG picture to write: the scan, and the mesh from four sides.", rich_help_panel=Panel.OUTPUT),
]
SaveOption = Annotated[
    Path | None,
    typer.Option(help="Fitted field to write, a .gnr file that gnrecon mesh reads.", rich_help_panel=Panel.OUTPUT),
]
HtmlOption = Annotated[
    Path | None,
    typer.Option(
        help="Interactive page to write: the model in 3-D and its report, in one HTML file.",
        rich_help_panel=Panel.OUTPUT,
    ),
]
SaveConfigOption = Annotated[
    Path | None,
    typer.Option(
        help="Configuration to write, with all options in effect, for --config.", rich_help_panel=Panel.OUTPUT
    ),
]
LogOption = Annotated[
    Path | None,
    typer.Option(
        help="File to append a log to: all that -v prints and more, with times.", rich_help_panel=Panel.OUTPUT
    ),
]
DryRunOption = Annotated[
    bool,
    typer.Option("--dry-run", help="Print what a run would do, and write nothing.", rich_help_panel=Panel.OUTPUT),
]
VerboseOption = Annotated[
    bool,
    typer.Option(
        "-v",
        "--verbose",
        help="Print choices, counts, and a line for each stage and step.",
        rich_help_panel=Panel.OUTPUT,
    ),
]


@with_table_options(batch=False)
def reconstruct_command(
    context: typer.Context,
    scans: ScansArgument,
    output: OutputOption,
    format: FormatOption = None,
    reference: ReferenceOption = None,
    report: ReportOption = None,
    preview: PreviewOption = None,
    save: SaveOption = None,
    html: HtmlOption = None,
    config: ConfigOption = None,
    words: SetOption = None,
    save_config: SaveConfigOption = None,
    log: LogOption = None,
    memory: MemoryOption = None,
    dry_run: DryRunOption = False,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
    verbose: VerboseOption = False,
    debug: DebugOption = False,
    help_all: HelpAllOption = False,
    **options: Any,
) -> None:
    """Reconstruct one scan: gnrecon SCAN -o MESH (the word reconstruct may be left out)."""
    from gnrecon.config import read_settings
    from gnrecon.io.run_files import Files

    del help_all, debug  # `main` reads it from the arguments, because it handles failures
    given = given_options(context, options) | ({} if memory is None else {"memory": memory})
    settings = read_settings(config, words or (), given)
    limit_mb = None if (limit := settings.of(scans[0]).get("memory")) is None else parse_megabytes(limit)
    chosen, named_reference = settings.for_single_run(scans[0])
    files = Files(
        tuple(scans),
        output,
        reference or named_reference,
        report,
        preview,
        save,
        html,
        overwrite,
        format,
        config=save_config,
        settings=config,
    )
    files.check()
    if dry_run:
        from gnrecon.cli.scan_info import info
        from gnrecon.runtime.logs import require_log

        if log is not None:
            require_log(log, files.named)
        raise SystemExit(info(scans, chosen, format))
    if limit_mb is not None:
        continue_in_child(limit_mb)
    from gnrecon.run import run

    raise SystemExit(run(files, chosen, command=context.obj, quiet=quiet, verbose=verbose, log=log))
