"""The command ``gnrecon learn PROBLEM -o MESH``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

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
    typer.Option(help="gn (Gauss-Newton), or the paper's baselines, lbfgs and adam.", rich_help_panel=Panel.FIT),
]
BudgetOption = Annotated[
    float | None,
    typer.Option(help="Time limit in seconds; by default 600.", rich_help_panel=Panel.FIT),
]
StepsOption = Annotated[
    int | None,
    typer.Option(
        help="Limit of steps; without a budget, the same steps and seed give the same mesh.",
        rich_help_panel=Panel.FIT,
    ),
]
WiderOption = Annotated[
    int,
    typer.Option(
        help="Additional hidden units in each layer at the start; the least needed units are pruned again.",
        rich_help_panel=Panel.FIT,
    ),
]
ResolutionOption = Annotated[
    int, typer.Option(help="Cells along the longest side of the box that is meshed.", rich_help_panel=Panel.MESH)
]
DataOption = Annotated[
    Path | None,
    typer.Option(help="Folder of bun_zipper.ply and rocker-arm.off.", rich_help_panel=Panel.POINTS),
]
ShareOption = Annotated[
    float | None,
    typer.Option(help="For a scan: share of the points to learn from, such as 0.2.", rich_help_panel=Panel.POINTS),
]
RegionOption = Annotated[
    Path | None,
    typer.Option(
        help="For a bracket: closed mesh that bounds the part; by default that of sample_data.",
        rich_help_panel=Panel.DESIGN,
    ),
]
InterfacesOption = Annotated[
    Path | None,
    typer.Option(
        help="For a bracket: open mesh that the part attaches to, with faces pointing out of the part.",
        rich_help_panel=Panel.DESIGN,
    ),
]
InterfacesFrameOption = Annotated[
    str | None,
    typer.Option(
        metavar="X,Y,Z,SCALE",
        help="Origin and scale of the interfaces' coordinates in those of the region.",
        rich_help_panel=Panel.DESIGN,
    ),
]
ClipOption = Annotated[
    float | None,
    typer.Option(
        help="Upper limit of the strain k1^2 + k2^2 in the loss, in units where the region's half-length is 1.",
        rich_help_panel=Panel.DESIGN,
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
) -> None:
    """Learn a surface from constraints alone: the paper's data-free problems, or a part from its design."""
    from gnrecon.cli.learn_inputs import DesignFiles, ScanFiles
    from gnrecon.cli.learn_problem import LearnOptions, run_learn

    del debug
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
