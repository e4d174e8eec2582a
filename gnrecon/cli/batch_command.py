"""The command ``gnrecon batch SCANS -o FOLDER``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from gnrecon.cli.command_classes import HelpAllOption
from gnrecon.cli.option_parameters import given_options, valued_option, with_table_options
from gnrecon.cli.shared_parameters import (
    ConfigOption,
    DebugOption,
    MemoryOption,
    OverwriteOption,
    QuietOption,
    SetOption,
)
from gnrecon.option_table import Panel

OutputOption = Annotated[
    Path, typer.Option("-o", "--output", help="Folder for the meshes.", rich_help_panel=Panel.OUTPUT)
]
ScansArgument = Annotated[
    list[str] | None,
    typer.Argument(help="Folders of scans, scans, or patterns in quotes such as 'site/*/*.e57'."),
]
ListsOption = Annotated[
    list[Path] | None,
    typer.Option("--list", help="File with a scan, folder or pattern on each line.", rich_help_panel=Panel.BATCH),
]
PatternOption = Annotated[
    list[str] | None,
    valued_option(
        help="Take files of this name from folders, such as '*.ply'.",
        panel=Panel.BATCH,
        default="every format that is read",
    ),
]
RecursiveOption = Annotated[
    bool, typer.Option("--recursive", "-r", help="Enter subfolders.", rich_help_panel=Panel.BATCH)
]
NameOption = Annotated[
    str | None,
    valued_option(
        metavar="TEMPLATE",
        help="Names of the outputs, from {stem}, {name}, {folder}, {parent} and {index}.",
        panel=Panel.BATCH,
        default="{folder}/{stem}",
    ),
]
JobsOption = Annotated[
    str,
    valued_option(
        help="Scans at a time: a number, or auto, from cores and memory.",
        panel=Panel.BATCH,
        limits="at least 1",
        default="auto",
    ),
]
TimeoutOption = Annotated[
    str | None,
    valued_option(
        metavar="TIME",
        help="Time limit for a scan: 90, 10m, 2h.",
        panel=Panel.BATCH,
        limits="above 0",
        default="none",
    ),
]
RetryOption = Annotated[
    int,
    valued_option(
        help="Further attempts at a scan that was killed or exceeded a limit of time or memory.",
        panel=Panel.BATCH,
        limits="at least 0",
        default="0",
    ),
]
EngineOption = Annotated[
    str,
    valued_option(
        help="local, or dask for a Dask cluster of processes on this machine.", panel=Panel.BATCH, default="local"
    ),
]
SchedulerOption = Annotated[
    str | None,
    valued_option(
        metavar="ADDRESS",
        help="Address of a running Dask cluster, such as tcp://host:8786.",
        panel=Panel.BATCH,
        default="off",
    ),
]
FreshOption = Annotated[
    bool,
    typer.Option("--fresh", help="Reconstruct finished scans again, too.", rich_help_panel=Panel.BATCH),
]
MeshFormatOption = Annotated[
    str,
    valued_option(
        "--format", help="Format of the meshes: obj, ply, stl, off, glb or 3mf.", panel=Panel.OUTPUT, default="obj"
    ),
]
ReportsOption = Annotated[
    bool,
    typer.Option(
        "--reports", help="Write a JSON report next to each mesh: NAME.report.json.", rich_help_panel=Panel.OUTPUT
    ),
]
PagesOption = Annotated[
    bool,
    typer.Option(
        "--pages", help="Write a page next to each mesh, see --html: NAME.html.", rich_help_panel=Panel.OUTPUT
    ),
]
PreviewsOption = Annotated[
    bool,
    typer.Option(
        "--previews", help="Write a picture next to each mesh: NAME.preview.png.", rich_help_panel=Panel.OUTPUT
    ),
]
ModelsOption = Annotated[
    bool,
    typer.Option("--models", help="Write each fitted field: NAME.gnr.", rich_help_panel=Panel.OUTPUT),
]
ReferenceDirOption = Annotated[
    Path | None,
    typer.Option(help="Folder of references to measure against, one for each scan.", rich_help_panel=Panel.BATCH),
]
ReferenceNameOption = Annotated[
    str | None,
    valued_option(
        metavar="TEMPLATE",
        help="Names of the references, from the same fields as --name.",
        panel=Panel.BATCH,
        default="{stem}",
    ),
]


@with_table_options(batch=True)
def batch_command(
    context: typer.Context,
    output: OutputOption,
    scans: ScansArgument = None,
    lists: ListsOption = None,
    pattern: PatternOption = None,
    recursive: RecursiveOption = False,
    name: NameOption = None,
    jobs: JobsOption = "auto",
    timeout: TimeoutOption = None,
    memory: MemoryOption = None,
    retry: RetryOption = 0,
    engine: EngineOption = "local",
    scheduler: SchedulerOption = None,
    fresh: FreshOption = False,
    mesh_format: MeshFormatOption = "obj",
    reports: ReportsOption = False,
    pages: PagesOption = False,
    previews: PreviewsOption = False,
    models: ModelsOption = False,
    reference_dir: ReferenceDirOption = None,
    reference_name: ReferenceNameOption = None,
    config: ConfigOption = None,
    words: SetOption = None,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
    debug: DebugOption = False,
    help_all: HelpAllOption = False,
    **options: Any,
) -> None:
    """Reconstruct many scans, each in its own process; a failure stops no others, and finished scans are skipped."""
    from gnrecon.batch.request import Request
    from gnrecon.batch.runner import run_batch
    from gnrecon.config import read_settings

    del help_all, debug
    limits = {name: text for name, text in (("timeout", timeout), ("memory", memory)) if text is not None}
    side_files = {"report": reports, "page": pages, "preview": previews, "model": models}
    request = Request(
        sources=tuple(scans or ()),
        output=output,
        lists=tuple(lists or ()),
        patterns=tuple(pattern or ()),
        recursive=recursive,
        name=name,
        mesh_format=mesh_format,
        kinds=tuple(kind for kind, chosen in side_files.items() if chosen),
        settings=read_settings(config, words or (), given_options(context, options) | limits),
        references=reference_dir,
        reference_name=reference_name,
        jobs=_parse_jobs(jobs),
        retry=retry,
        engine=engine,
        scheduler=scheduler,
        overwrite=overwrite,
        fresh=fresh,
        quiet=quiet,
        command=context.obj,
    )
    raise SystemExit(run_batch(request))


def _parse_jobs(text: str) -> int | None:
    if text == "auto":
        return None
    try:
        return int(text)
    except ValueError:
        raise typer.BadParameter(f"The number of jobs must be a whole number or auto, not {text!r}.") from None
