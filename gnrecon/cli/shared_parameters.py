"""Parameters that several commands share and that are no rows of `gnrecon.option_table`: files and output."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gnrecon.cli.option_parameters import table_option, valued_option
from gnrecon.option_table import Panel

OutputOption = Annotated[
    Path,
    typer.Option(
        "-o", "--output", help="Mesh to write: .obj, .ply, .stl, .off, .glb or .3mf.", rich_help_panel=Panel.OUTPUT
    ),
]
FormatOption = Annotated[
    str | None,
    valued_option(help="Format of the scan, such as ply.", panel=Panel.POINTS, default="its file's extension"),
]
ColumnsOption = Annotated[str | None, table_option("columns")]
CurvatureOption = Annotated[bool, table_option("curvature")]
SeedOption = Annotated[int, table_option("seed")]
ThreadsOption = Annotated[int | None, table_option("threads")]
ConfigOption = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="TOML file with options by name, and tables of options for certain scans.",
        rich_help_panel=Panel.OUTPUT,
    ),
]
SetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="NAME=VALUE", help="Set an option by name; may be repeated.", rich_help_panel=Panel.OUTPUT
    ),
]
OverwriteOption = Annotated[
    bool,
    typer.Option(
        "--overwrite",
        help="Replace existing files, but never an input: scans, files that a .conf or a glTF names, the reference, "
        "the configuration.",
        rich_help_panel=Panel.OUTPUT,
    ),
]
QuietOption = Annotated[bool, typer.Option("-q", "--quiet", help="Print failures only.", rich_help_panel=Panel.OUTPUT)]
DebugOption = Annotated[
    bool, typer.Option("--debug", help="Print a traceback on failure.", rich_help_panel=Panel.OUTPUT)
]
MemoryOption = Annotated[
    str | None,
    valued_option(
        metavar="SIZE",
        help="Limit of resident memory for a scan: 800MB, 4GB.",
        panel=Panel.FIT,
        limits="above 0",
        default="none",
    ),
]
