"""The command ``gnrecon learn PROBLEM -o MESH``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gnrecon.cli.command_classes import HelpAllOption
from gnrecon.cli.option_parameters import valued_option
from gnrecon.cli.shared_parameters import (
    CurvatureOption,
    DebugOption,
    OutputOption,
    OverwriteOption,
    QuietOption,
    SeedOption,
    ThreadsOption,
)
from gnrecon.option_table import Panel

ProblemArgument = Annotated[
    str,
    typer.Argument(
        help="catenoid or enneper (minimal surfaces), cone (a developable one), bracket (a part), bunny or "
        "rockerarm (the paper's scans), or the file of a scan."
    ),
]
OptimiserOption = Annotated[
    str,
    valued_option(help="gn (Gauss-Newton), or the paper's baselines, lbfgs and adam.", panel=Panel.FIT, default="gn"),
]
BudgetOption = Annotated[
    float | None,
    valued_option(
        help="Time limit in seconds.", panel=Panel.FIT, limits="above 0", default="600, or none with --steps"
    ),
]
StepsOption = Annotated[
    int | None,
    valued_option(
        help="Limit of steps; without a budget, the same steps, seed and threads give the same mesh.",
        panel=Panel.FIT,
        limits="at least 1",
        default="none",
    ),
]
WiderOption = Annotated[
    int,
    valued_option(
        help="Additional hidden units in each layer at the start; the least needed units are pruned again.",
        panel=Panel.FIT,
        limits="at least 0",
        default="0",
    ),
]
ResolutionOption = Annotated[
    int,
    valued_option(
        help="Cells along the longest side of the box that is meshed.",
        panel=Panel.MESH,
        limits="at least 16",
        default="192",
    ),
]
DataOption = Annotated[
    Path | None,
    valued_option(
        help="Folder of bun_zipper.ply and rocker-arm.off, which bunny and rockerarm need.",
        panel=Panel.POINTS,
        default="none",
    ),
]
ShareOption = Annotated[
    float | None,
    valued_option(
        help="For a scan: share of the points to learn from, such as 0.2.",
        panel=Panel.POINTS,
        limits="above 0, up to 1",
        default="1",
    ),
]
RegionOption = Annotated[
    Path | None,
    valued_option(
        help="For a bracket: closed mesh that bounds the part.", panel=Panel.DESIGN, default="that of sample_data"
    ),
]
InterfacesOption = Annotated[
    Path | None,
    valued_option(
        help="For a bracket: open mesh that the part attaches to, with faces pointing out of the part.",
        panel=Panel.DESIGN,
        default="that of sample_data",
    ),
]
InterfacesFrameOption = Annotated[
    str | None,
    valued_option(
        metavar="X,Y,Z,SCALE",
        help="Origin and scale of the interfaces' coordinates in those of the region.",
        panel=Panel.DESIGN,
        limits="scale above 0",
        default="the same coordinates",
    ),
]
ClipOption = Annotated[
    float | None,
    valued_option(
        help="Upper limit of the strain k1^2 + k2^2 in the loss, in units where the region's half-length is 1.",
        panel=Panel.DESIGN,
        limits="above 0",
        default="none",
    ),
]
ReportOption = Annotated[Path | None, typer.Option(help="JSON report to write.", rich_help_panel=Panel.OUTPUT)]
VerboseOption = Annotated[
    bool, typer.Option("-v", "--verbose", help="Print each measurement.", rich_help_panel=Panel.OUTPUT)
]


def learn_command(
    context: typer.Context,
    problem: ProblemArgument,
    output: OutputOption,
    optimiser: OptimiserOption = "gn",
    budget: BudgetOption = None,
    steps: StepsOption = None,
    wider: WiderOption = 0,
    seed: SeedOption = 0,
    threads: ThreadsOption = None,
    resolution: ResolutionOption = 192,
    curvature: CurvatureOption = False,
    data: DataOption = None,
    share: ShareOption = None,
    region: RegionOption = None,
    interfaces: InterfacesOption = None,
    interfaces_frame: InterfacesFrameOption = None,
    clip: ClipOption = None,
    report: ReportOption = None,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
    verbose: VerboseOption = False,
    debug: DebugOption = False,
    help_all: HelpAllOption = False,
) -> None:
    """Learn a surface from constraints alone: the paper's data-free problems, or a part from its design."""
    from gnrecon.cli.learn_inputs import DesignFiles, ScanFiles
    from gnrecon.cli.learn_problem import LearnOptions, run_learn

    del help_all, debug
    options = LearnOptions(optimiser, budget, steps, seed, resolution, curvature, threads, wider)
    raise SystemExit(
        run_learn(
            problem,
            output,
            options,
            files=DesignFiles(region, interfaces, interfaces_frame, clip),
            scan=ScanFiles(data, share),
            report=report,
            overwrite=overwrite,
            quiet=quiet,
            verbose=verbose,
            command=context.obj,
        )
    )
