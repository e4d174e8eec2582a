"""The command line: ``gnrecon scan.ply -o mesh.obj``, and the other commands by their names.

A first word that names no command is a scan. Results go to files, figures that were asked for to stdout, everything
else to stderr. Each foreseen failure ends in one sentence and the exit code of `gnrecon.runtime.errors`.
"""

from __future__ import annotations

import os
import shlex
import signal
import sys
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from types import FrameType
from typing import Annotated, Any, NoReturn

import typer

from gnrecon.cli.arguments import (
    BATCH,
    DESIGN,
    EDGE_LENGTH_HELP,
    FIT,
    MAX_ERROR_HELP,
    MESH,
    OUTPUT,
    POINTS,
    Adaptive,
    Attributes,
    BlockScheduler,
    ClipPlane,
    Clusters,
    Config,
    Crop,
    Curvature,
    Debug,
    Device,
    EdgeLength,
    Faces,
    FeatureAngle,
    Fill,
    Format,
    Fraction,
    Holdout,
    KeepHandles,
    Log,
    MaxError,
    MaxPoints,
    NormalResidual,
    Optimiser,
    Orient,
    Outliers,
    Output,
    Overwrite,
    Prior,
    Quality,
    Quiet,
    ReadPoints,
    Remesh,
    Resolution,
    SearchOption,
    Seed,
    SetOption,
    Simplify,
    Smooth,
    SmoothScan,
    Solver,
    Spacing,
    Steps,
    Subsample,
    Threads,
    Trim,
    UncertaintyOption,
    Units,
    Verbose,
    Widths,
    WorkDir,
)
from gnrecon.runtime.errors import ExitCode, failure
from gnrecon.version import __version__

# Newer versions of typer carry their own click, older ones import it: this is the base of whichever is in use.
_CommandLineError: Any = typer.BadParameter.__mro__[2]

COMMANDS = ("reconstruct", "batch", "mesh", "learn", "eval", "convert", "check", "info", "doctor", "schema")
DEFAULT_COMMAND = "reconstruct"

app = typer.Typer(
    name="gnrecon",
    help="Watertight, verified meshes from point clouds: gnrecon SCAN -o MESH",
    epilog="Exit codes: 0 ok, 1 unforeseen, 2 usage, 3 input, 4 fit, 5 mesh not sound, 6 could not write, 7 memory, "
    "8 some of a batch failed, 130 interrupted.",
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


@app.command(DEFAULT_COMMAND)
def reconstruct_command(
    context: typer.Context,
    scans: Annotated[
        list[Path],
        typer.Argument(
            help="One or more scans of an object, merged after the poses that they hold: PLY, PCD, XYZ, PTS, TXT, CSV, "
            "LAS, LAZ, E57, PTX, VTK, VTP, OBJ, OFF, STL, glTF, GLB or 3MF, compressed by gzip or not; CONF names "
            "scans with their poses; - is standard input."
        ),
    ],
    output: Output,
    format: Format = None,
    read_points: ReadPoints = 2_000_000,
    crop: Crop = (),  # type: ignore[assignment]
    clip_plane: ClipPlane = (),  # type: ignore[assignment]
    units: Units = None,
    fraction: Fraction = None,
    max_points: MaxPoints = None,
    spacing: Spacing = None,
    subsample: Subsample = "random",
    holdout: Holdout = None,
    outliers: Outliers = "auto",
    clusters: Clusters = "auto",
    smooth_scan: SmoothScan = None,
    orient: Orient = "auto",
    smooth: Smooth = None,
    fill: Fill = None,
    prior: Prior = None,
    widths: Widths = None,
    steps: Steps = None,
    quality: Quality = "normal",
    normal_residual: NormalResidual = "vector",
    optimiser: Optimiser = "gn",
    solver: Solver = "auto",
    search: SearchOption = "auto",
    seed: Seed = 0,
    device: Device = "cpu",
    threads: Threads = None,
    work_dir: WorkDir = None,
    block_scheduler: BlockScheduler = None,
    resolution: Resolution = None,
    edge_length: EdgeLength = None,
    max_error: MaxError = None,
    attributes: Attributes = "auto",
    curvature: Curvature = False,
    keep_handles: KeepHandles = False,
    trim: Trim = None,
    uncertainty: UncertaintyOption = False,
    remesh: Remesh = None,
    adaptive: Adaptive = False,
    simplify: Simplify = None,
    faces: Faces = None,
    feature_angle: FeatureAngle = 30.0,
    reference: Annotated[
        Path | None,
        typer.Option(help="Mesh or cloud to measure the result against; printed to stdout.", rich_help_panel=OUTPUT),
    ] = None,
    report: Annotated[Path | None, typer.Option(help="JSON report to write.", rich_help_panel=OUTPUT)] = None,
    preview: Annotated[
        Path | None,
        typer.Option(help="PNG picture to write: the scan, and the mesh from four sides.", rich_help_panel=OUTPUT),
    ] = None,
    save: Annotated[
        Path | None,
        typer.Option(help="Fitted field to write, a .gnr file that gnrecon mesh reads.", rich_help_panel=OUTPUT),
    ] = None,
    html: Annotated[
        Path | None,
        typer.Option(
            help="Page to write: the model in 3-D with all that is known of it, in one HTML file.",
            rich_help_panel=OUTPUT,
        ),
    ] = None,
    config: Config = None,
    words: SetOption = (),  # type: ignore[assignment]
    save_config: Annotated[
        Path | None,
        typer.Option(help="Configuration to write, with all options in effect, for --config.", rich_help_panel=OUTPUT),
    ] = None,
    log: Log = None,
    dry_run: Annotated[
        bool,
        typer.Option("--dry-run", help="Tell what would be done, and write nothing.", rich_help_panel=OUTPUT),
    ] = False,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    debug: Debug = False,
) -> None:
    """Reconstruct one scan: gnrecon SCAN -o MESH (the word reconstruct may be left out)."""
    from gnrecon.config import LIMITS, REFERENCE, read_settings
    from gnrecon.run import Files, run

    settings = read_settings(config, words, _given(context, locals()))
    options = {name: value for name, value in settings.of(scans[0]).items() if name not in LIMITS}
    truth = reference or options.pop(REFERENCE, None)
    options.pop(REFERENCE, None)
    del debug  # read from the arguments by `main`, which handles failures
    files = Files(
        tuple(scans),
        output,
        truth,
        report,
        preview,
        save,
        html,
        overwrite,
        format,
        config=save_config,
        settings=config,
    )
    if dry_run:
        from gnrecon.cli.info_command import info

        files.check()
        raise SystemExit(info(scans, options, format))
    raise SystemExit(run(files, options, command=context.obj, quiet=quiet, verbose=verbose, log=log))


@app.command("batch")
def batch_command(
    context: typer.Context,
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder for the meshes.", rich_help_panel=OUTPUT)],
    scans: Annotated[
        list[str] | None,
        typer.Argument(help="Folders of scans, scans, or patterns in quotes such as 'site/*/*.e57'."),
    ] = None,
    lists: Annotated[
        list[Path],
        typer.Option("--list", help="File with a scan, folder or pattern on each line.", rich_help_panel=BATCH),
    ] = (),  # type: ignore[assignment]
    pattern: Annotated[
        list[str],
        typer.Option(help="Take files of this name from folders, such as '*.ply'.", rich_help_panel=BATCH),
    ] = (),  # type: ignore[assignment]
    recursive: Annotated[
        bool, typer.Option("--recursive", "-r", help="Enter subfolders.", rich_help_panel=BATCH)
    ] = False,
    name: Annotated[
        str | None,
        typer.Option(
            metavar="TEMPLATE",
            help="Names of the outputs, from {stem}, {name}, {folder}, {parent} and {index}; by default "
            "{folder}/{stem}.",
            rich_help_panel=BATCH,
        ),
    ] = None,
    jobs: Annotated[
        str,
        typer.Option(help="Scans at a time: a number, or auto, by cores and memory.", rich_help_panel=BATCH),
    ] = "auto",
    timeout: Annotated[
        str | None,
        typer.Option(metavar="TIME", help="Most time for a scan: 90, 10m, 2h.", rich_help_panel=BATCH),
    ] = None,
    memory: Annotated[
        str | None,
        typer.Option(metavar="SIZE", help="Most resident memory for a scan: 800MB, 4GB.", rich_help_panel=BATCH),
    ] = None,
    retry: Annotated[
        int,
        typer.Option(
            help="Further attempts at a scan that was killed, took too long or too much memory.", rich_help_panel=BATCH
        ),
    ] = 0,
    engine: Annotated[
        str,
        typer.Option(help="local, or dask for a Dask cluster of this machine's processes.", rich_help_panel=BATCH),
    ] = "local",
    scheduler: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS", help="A Dask cluster that is there, such as tcp://host:8786.", rich_help_panel=BATCH
        ),
    ] = None,
    fresh: Annotated[
        bool,
        typer.Option("--fresh", help="Do again what is done already, too.", rich_help_panel=BATCH),
    ] = False,
    mesh_format: Annotated[
        str,
        typer.Option("--format", help="Format of the meshes: obj, ply, stl, off, glb or 3mf.", rich_help_panel=OUTPUT),
    ] = "obj",
    read_points: ReadPoints = 2_000_000,
    crop: Crop = (),  # type: ignore[assignment]
    clip_plane: ClipPlane = (),  # type: ignore[assignment]
    units: Units = None,
    fraction: Fraction = None,
    max_points: MaxPoints = None,
    spacing: Spacing = None,
    subsample: Subsample = "random",
    holdout: Holdout = None,
    outliers: Outliers = "auto",
    clusters: Clusters = "auto",
    smooth_scan: SmoothScan = None,
    orient: Orient = "auto",
    smooth: Smooth = None,
    fill: Fill = None,
    prior: Prior = None,
    widths: Widths = None,
    steps: Steps = None,
    quality: Quality = "normal",
    normal_residual: NormalResidual = "vector",
    optimiser: Optimiser = "gn",
    solver: Solver = "auto",
    search: SearchOption = "auto",
    seed: Seed = 0,
    device: Device = "cpu",
    threads: Threads = None,
    resolution: Resolution = None,
    edge_length: EdgeLength = None,
    max_error: MaxError = None,
    attributes: Attributes = "auto",
    curvature: Curvature = False,
    keep_handles: KeepHandles = False,
    trim: Trim = None,
    uncertainty: UncertaintyOption = False,
    remesh: Remesh = None,
    adaptive: Adaptive = False,
    simplify: Simplify = None,
    faces: Faces = None,
    feature_angle: FeatureAngle = 30.0,
    reports: Annotated[
        bool,
        typer.Option(
            "--reports", help="Write a JSON report beside each mesh: NAME.report.json.", rich_help_panel=OUTPUT
        ),
    ] = False,
    pages: Annotated[
        bool,
        typer.Option("--pages", help="Write a page beside each mesh, see --html: NAME.html.", rich_help_panel=OUTPUT),
    ] = False,
    previews: Annotated[
        bool,
        typer.Option("--previews", help="Write a picture beside each mesh: NAME.preview.png.", rich_help_panel=OUTPUT),
    ] = False,
    models: Annotated[
        bool,
        typer.Option("--models", help="Write each fitted field, too: NAME.gnr.", rich_help_panel=OUTPUT),
    ] = False,
    reference_dir: Annotated[
        Path | None,
        typer.Option(help="Folder of references, one for each scan, to measure against.", rich_help_panel=BATCH),
    ] = None,
    reference_name: Annotated[
        str | None,
        typer.Option(
            metavar="TEMPLATE", help="Their names, from the same fields; by default {stem}.", rich_help_panel=BATCH
        ),
    ] = None,
    config: Config = None,
    words: SetOption = (),  # type: ignore[assignment]
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Reconstruct many scans, each in a process of its own; one failure stops nothing, and nothing is done twice."""
    from gnrecon.batch.request import Request
    from gnrecon.batch.runner import run_batch
    from gnrecon.config import read_settings

    del debug
    limits = {name: text for name, text in (("timeout", timeout), ("memory", memory)) if text is not None}
    wanted = {"report": reports, "page": pages, "preview": previews, "model": models}
    request = Request(
        sources=tuple(scans or ()),
        output=output,
        lists=tuple(lists),
        patterns=tuple(pattern),
        recursive=recursive,
        name=name,
        mesh_format=mesh_format,
        kinds=tuple(kind for kind, asked in wanted.items() if asked),
        settings=read_settings(config, words, _given(context, locals()) | limits),
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


def _given(context: typer.Context, values: Mapping[str, Any]) -> dict[str, Any]:
    """The options of the reconstruction among a command's values that were given, not left to their defaults."""
    from gnrecon.options import Options

    names = [option.name for option in fields(Options)]
    sources = {name: context.get_parameter_source(name) for name in names}
    options = {name: values[name] for name, source in sources.items() if source and source.name != "DEFAULT"}
    if "widths" in options:
        options["widths"] = parse_widths(options["widths"])
    return options


def _parse_jobs(text: str) -> int | None:
    if text == "auto":
        return None
    try:
        return int(text)
    except ValueError:
        raise typer.BadParameter(f"The number of jobs is a whole number or auto, not {text!r}.") from None


@app.command("mesh")
def mesh_command(
    model: Annotated[Path, typer.Argument(help="Fitted field, a .gnr file that --save wrote.")],
    output: Output,
    resolution: Resolution = None,
    edge_length: Annotated[str | None, typer.Option(help=EDGE_LENGTH_HELP, rich_help_panel=MESH)] = None,
    max_error: Annotated[str | None, typer.Option(help=MAX_ERROR_HELP, rich_help_panel=MESH)] = None,
    crop: Annotated[
        str | None,
        typer.Option(
            help="Box to keep: xmin,ymin,zmin,xmax,ymax,zmax in file units; the resolution is the box's then, and cuts "
            "are closed by flat caps.",
            rich_help_panel=MESH,
        ),
    ] = None,
    offset: Annotated[
        str,
        typer.Option(
            help="Move the surface outward, inward if negative: 0.5, or 2mm with --units.", rich_help_panel=MESH
        ),
    ] = "0",
    shell: Annotated[
        str | None,
        typer.Option(help="Hollow the solid to a wall of this thickness, measured inward.", rich_help_panel=MESH),
    ] = None,
    units: Annotated[
        str | None,
        typer.Option(
            help="The file's own unit (um, mm, cm, m, km, in, ft), for lengths with a suffix.", rich_help_panel=MESH
        ),
    ] = None,
    keep_handles: KeepHandles = False,
    remesh: Remesh = None,
    adaptive: Adaptive = False,
    simplify: Simplify = None,
    faces: Faces = None,
    feature_angle: FeatureAngle = 30.0,
    attributes: Annotated[
        str,
        typer.Option(help="auto (the distance to the model's points) or none.", rich_help_panel=MESH),
    ] = "auto",
    curvature: Curvature = False,
    device: Annotated[
        str, typer.Option(help="Where the field is evaluated: cpu or cuda.", rich_help_panel=MESH)
    ] = "cpu",
    threads: Threads = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Mesh a fitted field again, without refitting: at another resolution, cropped, offset, or as a hollow shell."""
    import numpy as np

    from gnrecon.cli.mesh_command import remesh as mesh_again
    from gnrecon.geometry.units import parse_box, parse_length
    from gnrecon.solid import Shape

    del debug
    shape = Shape(
        parse_length(offset, units),
        None if shell is None else parse_length(shell, units),
        None if crop is None else np.array(parse_box(crop)),
    )
    options = {
        "resolution": resolution,
        "edge_length": None if edge_length is None else parse_length(edge_length, units),
        "max_error": None if max_error is None else parse_length(max_error, units),
        "keep_handles": keep_handles,
        "remesh": remesh,
        "adaptive": adaptive,
        "simplify": simplify,
        "faces": faces,
        "feature_angle": feature_angle,
        "attributes": attributes,
        "curvature": curvature,
        "device": device,
        "threads": threads,
    }
    raise SystemExit(mesh_again(model, output, options, shape, overwrite=overwrite, quiet=quiet))


@app.command("learn")
def learn_command(
    context: typer.Context,
    problem: Annotated[
        str,
        typer.Argument(
            help="catenoid or enneper (minimal surfaces), cone (a developable one), bracket (a part), bunny or "
            "rockerarm (the paper's scans), or the file of a scan."
        ),
    ],
    output: Output,
    optimiser: Annotated[
        str, typer.Option(help="gn (Gauss-Newton), lbfgs or adam, which the paper compares with.", rich_help_panel=FIT)
    ] = "gn",
    budget: Annotated[
        float | None,
        typer.Option(help="Seconds for the whole of the learning; by default 600.", rich_help_panel=FIT),
    ] = None,
    steps: Annotated[
        int | None,
        typer.Option(
            help="Most steps; without a budget, the same steps and seed give the same mesh.", rich_help_panel=FIT
        ),
    ] = None,
    wider: Annotated[
        int,
        typer.Option(
            help="Hidden units more that each layer begins with; those that are least needed are taken away again.",
            rich_help_panel=FIT,
        ),
    ] = 0,
    seed: Seed = 0,
    threads: Threads = None,
    resolution: Annotated[
        int, typer.Option(help="Cells along the longest side of the box that is meshed.", rich_help_panel=MESH)
    ] = 192,
    curvature: Curvature = False,
    data: Annotated[
        Path | None,
        typer.Option(help="Folder of bun_zipper.ply and rocker-arm.off.", rich_help_panel=POINTS),
    ] = None,
    share: Annotated[
        float | None,
        typer.Option(help="Of a scan: share of the points to learn from, such as 0.2.", rich_help_panel=POINTS),
    ] = None,
    region: Annotated[
        Path | None,
        typer.Option(
            help="Of a bracket: closed mesh to stay within; by default sample_data's.", rich_help_panel=DESIGN
        ),
    ] = None,
    interfaces: Annotated[
        Path | None,
        typer.Option(
            help="Of a bracket: open mesh to be attached to, its faces out of the part.", rich_help_panel=DESIGN
        ),
    ] = None,
    interfaces_frame: Annotated[
        str | None,
        typer.Option(
            metavar="X,Y,Z,SCALE",
            help="Origin and scale of the interfaces' own coordinates in the region's.",
            rich_help_panel=DESIGN,
        ),
    ] = None,
    clip: Annotated[
        float | None,
        typer.Option(help="Greatest strain k1^2 + k2^2 that counts, region's half-length 1.", rich_help_panel=DESIGN),
    ] = None,
    report: Annotated[Path | None, typer.Option(help="JSON report to write.", rich_help_panel=OUTPUT)] = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    verbose: Annotated[
        bool, typer.Option("-v", "--verbose", help="Print each measurement.", rich_help_panel=OUTPUT)
    ] = False,
    debug: Debug = False,
) -> None:
    """Learn a surface from constraints alone: the paper's data-free problems, or a part from its design."""
    from gnrecon.cli.learn_command import LearnOptions, run_learn
    from gnrecon.cli.learn_inputs import DesignFiles, ScanFiles

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


@app.command("eval")
def eval_command(
    mesh: Annotated[Path, typer.Argument(help="OBJ, PLY, STL, OFF, GLB or 3MF file.")],
    reference: Annotated[Path, typer.Option(help="Mesh or cloud to measure it against.")],
    samples: Annotated[int, typer.Option(help="Points drawn on each surface.")] = 100_000,
    seed: Seed = 0,
    report: Annotated[Path | None, typer.Option("--json", help="JSON file to write.", rich_help_panel=OUTPUT)] = None,
    overwrite: Overwrite = False,
    debug: Debug = False,
) -> None:
    """Print how far a mesh lies from a reference: Chamfer, RMS, Hausdorff, F-score, normal consistency."""
    from gnrecon.cli.inspect_commands import evaluate

    del debug
    raise SystemExit(evaluate(mesh, reference, samples=samples, seed=seed, report=report, overwrite=overwrite))


@app.command("convert")
def convert_command(
    source: Annotated[Path, typer.Argument(help="Mesh or cloud to read.")],
    target: Annotated[Path, typer.Argument(help="File to write; its extension names the format.")],
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Write a mesh or a cloud in another format, unchanged; whatever the format cannot hold is named."""
    from gnrecon.cli.inspect_commands import convert

    del debug
    raise SystemExit(convert(source, target, overwrite=overwrite, quiet=quiet))


@app.command("check")
def check_command(
    mesh: Annotated[Path, typer.Argument(help="OBJ, PLY, STL, OFF, GLB or 3MF file.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead of text.")] = False,
    debug: Debug = False,
) -> None:
    """Tell whether a mesh bounds a solid: exit code 0 if it is a closed, oriented 2-manifold, 5 if it is not."""
    from gnrecon.cli.inspect_commands import check

    del debug
    raise SystemExit(check(mesh, as_json=as_json))


@app.command("info")
def info_command(
    scans: Annotated[list[Path], typer.Argument(help="One or more scans; - is standard input.")],
    format: Format = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead of text.")] = False,
    debug: Debug = False,
) -> None:
    """Tell what is in a scan, what would trouble a fit, and what a run would do by default."""
    from gnrecon.cli.info_command import info

    del debug
    raise SystemExit(info(scans, {}, format, as_json=as_json))


@app.command("doctor")
def doctor_command() -> None:
    """Check the installation; name what is missing and the command that mends it."""
    from rich.console import Console

    from gnrecon.cli.doctor import diagnose, render

    checks = diagnose()
    render(checks, Console())
    raise SystemExit(0 if all(check.ok for check in checks) else ExitCode.INPUT)


@app.command("schema")
def schema_command() -> None:
    """Print the JSON schema of the report: every field with its meaning and unit."""
    from gnrecon.report.report import schema_text

    print(schema_text(), end="")


def parse_widths(text: str) -> tuple[int, ...]:
    """Return layer widths from text such as ``2000`` or ``32,32,32``.

    Raises
    ------
    typer.BadParameter
        When a part is no whole number.
    """
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError:
        raise typer.BadParameter(f"{text!r} is not a list of whole numbers such as 2000 or 32,32,32.") from None


def main(arguments: Sequence[str] | None = None) -> NoReturn:
    """Run the command line and exit."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if words == ["--version"]:
        print(f"gnrecon {__version__}")
        sys.exit(0)
    command = shlex.join(["gnrecon", *words])
    if words and words[0] not in (*COMMANDS, "-h", "--help"):
        words.insert(0, DEFAULT_COMMAND)
    # On a busy machine, threads that spin while they wait cost several times what they gain.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    # A polite kill must unwind, so that temporary files are removed.
    signal.signal(signal.SIGTERM, _terminate)
    sys.exit(_guarded(words, command))


def _terminate(number: int, frame: FrameType | None) -> NoReturn:
    del frame
    raise SystemExit(128 + number)


def _guarded(words: list[str], command: str) -> int:
    """Run the words and turn every failure into a sentence and an exit code; `command` is what was typed."""
    try:
        result: Any = app(words, standalone_mode=False, obj=command)
        # Newer versions of typer turn Ctrl-C into this value and say nothing; `run` and `run_batch` raise theirs.
        if result == ExitCode.INTERRUPTED:
            raise KeyboardInterrupt
        return int(result or 0)
    except typer.Exit as request:
        return request.exit_code
    except _CommandLineError as error:
        return _fail(error.format_message(), ExitCode.USAGE, words)
    except (KeyboardInterrupt, typer.Abort):
        return _fail(*failure(KeyboardInterrupt()), words)
    except Exception as error:
        return _fail(*failure(error), words)


def _fail(sentence: str, code: ExitCode, words: list[str]) -> int:
    if "--debug" in words:
        import traceback

        traceback.print_exc()
    print(f"gnrecon: {sentence}", file=sys.stderr)
    return int(code)
