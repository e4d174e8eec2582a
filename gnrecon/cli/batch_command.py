"""The command ``gnrecon batch SCANS -o FOLDER``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from gnrecon.cli.option_parameters import given_options, with_table_options
from gnrecon.cli.shared_parameters import Config, Debug, Overwrite, Quiet, SetOption
from gnrecon.option_table import Panel


@with_table_options(batch=True)
def batch_command(
    context: typer.Context,
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Folder for the meshes.", rich_help_panel=Panel.OUTPUT)
    ],
    scans: Annotated[
        list[str] | None,
        typer.Argument(help="Folders of scans, scans, or patterns in quotes such as 'site/*/*.e57'."),
    ] = None,
    lists: Annotated[
        list[Path] | None,
        typer.Option("--list", help="File with a scan, folder or pattern on each line.", rich_help_panel=Panel.BATCH),
    ] = None,
    pattern: Annotated[
        list[str] | None,
        typer.Option(help="Take files of this name from folders, such as '*.ply'.", rich_help_panel=Panel.BATCH),
    ] = None,
    recursive: Annotated[
        bool, typer.Option("--recursive", "-r", help="Enter subfolders.", rich_help_panel=Panel.BATCH)
    ] = False,
    name: Annotated[
        str | None,
        typer.Option(
            metavar="TEMPLATE",
            help="Names of the outputs, from {stem}, {name}, {folder}, {parent} and {index}; by default "
            "{folder}/{stem}.",
            rich_help_panel=Panel.BATCH,
        ),
    ] = None,
    jobs: Annotated[
        str,
        typer.Option(help="Scans at a time: a number, or auto, from cores and memory.", rich_help_panel=Panel.BATCH),
    ] = "auto",
    timeout: Annotated[
        str | None,
        typer.Option(metavar="TIME", help="Time limit for a scan: 90, 10m, 2h.", rich_help_panel=Panel.BATCH),
    ] = None,
    memory: Annotated[
        str | None,
        typer.Option(
            metavar="SIZE", help="Limit of resident memory for a scan: 800MB, 4GB.", rich_help_panel=Panel.BATCH
        ),
    ] = None,
    retry: Annotated[
        int,
        typer.Option(
            help="Further attempts at a scan that was killed or exceeded a limit of time or memory.",
            rich_help_panel=Panel.BATCH,
        ),
    ] = 0,
    engine: Annotated[
        str,
        typer.Option(
            help="local, or dask for a Dask cluster of processes on this machine.", rich_help_panel=Panel.BATCH
        ),
    ] = "local",
    scheduler: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Address of a running Dask cluster, such as tcp://host:8786.",
            rich_help_panel=Panel.BATCH,
        ),
    ] = None,
    fresh: Annotated[
        bool,
        typer.Option("--fresh", help="Reconstruct finished scans again, too.", rich_help_panel=Panel.BATCH),
    ] = False,
    mesh_format: Annotated[
        str,
        typer.Option(
            "--format", help="Format of the meshes: obj, ply, stl, off, glb or 3mf.", rich_help_panel=Panel.OUTPUT
        ),
    ] = "obj",
    reports: Annotated[
        bool,
        typer.Option(
            "--reports", help="Write a JSON report next to each mesh: NAME.report.json.", rich_help_panel=Panel.OUTPUT
        ),
    ] = False,
    pages: Annotated[
        bool,
        typer.Option(
            "--pages", help="Write a page next to each mesh, see --html: NAME.html.", rich_help_panel=Panel.OUTPUT
        ),
    ] = False,
    previews: Annotated[
        bool,
        typer.Option(
            "--previews", help="Write a picture next to each mesh: NAME.preview.png.", rich_help_panel=Panel.OUTPUT
        ),
    ] = False,
    models: Annotated[
        bool,
        typer.Option("--models", help="Write each fitted field: NAME.gnr.", rich_help_panel=Panel.OUTPUT),
    ] = False,
    reference_dir: Annotated[
        Path | None,
        typer.Option(help="Folder of references to measure against, one for each scan.", rich_help_panel=Panel.BATCH),
    ] = None,
    reference_name: Annotated[
        str | None,
        typer.Option(
            metavar="TEMPLATE",
            help="Names of the references, from the same fields as --name; by default {stem}.",
            rich_help_panel=Panel.BATCH,
        ),
    ] = None,
    config: Config = None,
    words: SetOption = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    debug: Debug = False,
    **options: Any,
) -> None:
    """Reconstruct many scans, each in its own process; a failure stops no others, and finished scans are skipped."""
    from gnrecon.batch.request import Request
    from gnrecon.batch.runner import run_batch
    from gnrecon.config import read_settings

    del debug
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
