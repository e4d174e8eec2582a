"""The command ``gnrecon mesh MODEL -o MESH``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gnrecon.cli.command_classes import HelpAllOption
from gnrecon.cli.option_parameters import table_option, valued_option
from gnrecon.cli.shared_parameters import (
    CurvatureOption,
    DebugOption,
    OutputOption,
    OverwriteOption,
    QuietOption,
    ThreadsOption,
)
from gnrecon.option_table import OptionTable, Panel

ModelArgument = Annotated[Path, typer.Argument(help="Fitted field, a .gnr file that --save wrote.")]
ResolutionOption = Annotated[int | None, table_option("resolution")]
EdgeLengthOption = Annotated[str | None, table_option("edge_length")]
MaxErrorOption = Annotated[str | None, table_option("max_error")]
CropOption = Annotated[
    str | None,
    valued_option(
        help="Box to keep: xmin,ymin,zmin,xmax,ymax,zmax in file units; the resolution is then that of the box, "
        "and cuts are closed by flat caps.",
        panel=Panel.MESH,
        default="all",
        metavar="BOX",
    ),
]
OffsetOption = Annotated[
    str,
    valued_option(
        help="Move the surface outward, inward if negative: 0.5, or 2mm with --units.",
        panel=Panel.MESH,
        limits="any length",
        default="0",
        metavar="LENGTH",
    ),
]
ShellOption = Annotated[
    str | None,
    valued_option(
        help="Hollow the solid to a wall of this thickness, measured inward, in file units.",
        panel=Panel.MESH,
        limits="above 0",
        default="off",
        metavar="LENGTH",
    ),
]
UnitsOption = Annotated[
    str | None,
    valued_option(
        help="Unit of the file (um, mm, cm, m, km, in, ft); lengths may then have a unit, such as 2mm.",
        panel=Panel.MESH,
        default="unknown",
    ),
]
KeepHandlesOption = Annotated[bool, table_option("keep_handles")]
RemeshOption = Annotated[float | None, table_option("remesh")]
AdaptiveOption = Annotated[bool, table_option("adaptive")]
SimplifyOption = Annotated[float | None, table_option("simplify")]
FacesOption = Annotated[int | None, table_option("faces")]
FeatureAngleOption = Annotated[float, table_option("feature_angle")]
AttributesOption = Annotated[
    str,
    valued_option(help="auto (the distance to the model's points) or none.", panel=Panel.MESH, default="auto"),
]
DeviceOption = Annotated[
    str, valued_option(help="Where the field is evaluated: cpu or cuda.", panel=Panel.MESH, default="cpu")
]


def mesh_command(
    model: ModelArgument,
    output: OutputOption,
    resolution: ResolutionOption = None,
    edge_length: EdgeLengthOption = None,
    max_error: MaxErrorOption = None,
    crop: CropOption = None,
    offset: OffsetOption = "0",
    shell: ShellOption = None,
    units: UnitsOption = None,
    keep_handles: KeepHandlesOption = False,
    remesh: RemeshOption = None,
    adaptive: AdaptiveOption = False,
    simplify: SimplifyOption = None,
    faces: FacesOption = None,
    feature_angle: FeatureAngleOption = OptionTable.feature_angle,
    attributes: AttributesOption = "auto",
    curvature: CurvatureOption = False,
    device: DeviceOption = "cpu",
    threads: ThreadsOption = None,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
    debug: DebugOption = False,
    help_all: HelpAllOption = False,
) -> None:
    """Mesh a fitted field again, without refitting: at another resolution, cropped, offset, or as a hollow shell."""
    import numpy as np

    from gnrecon.cli.remesh_model import remesh_model
    from gnrecon.geometry.units import parse_box, parse_length
    from gnrecon.solid import Shape

    del help_all, debug
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
    raise SystemExit(remesh_model(model, output, options, shape, overwrite=overwrite, quiet=quiet))
