"""The table of a reconstruction's options: one row for each, with type, default, help text and command-line form.

Everything that takes options is made from it: the commands ``reconstruct`` and ``batch``, TOML files, ``--set``, the
arguments of `gnrecon.reconstruct`, and `gnrecon.options.Options`, which adds the checks. To add an option, add a row
here and use the field where it takes effect.

Only the standard library is imported here, because the command line reads the table each time that it starts.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from enum import StrEnum
from functools import cache
from typing import Any, get_type_hints

from gnrecon.runtime.typed_values import value_types


class Panel(StrEnum):
    """Headings under which ``--help`` lists options, in this order for those of the table."""

    POINTS = "Points"
    FIT = "Fit"
    MESH = "Mesh"
    OUTPUT = "Output"
    DESIGN = "Design"
    BATCH = "Batch"


@dataclass(frozen=True)
class OptionRow:
    """One row of the table.

    Parameters
    ----------
    name : of the field, and of the option in TOML, ``--set`` and Python
    types : that a value may have besides None, numbers before text
    default : None where the option is off, or chosen from the data
    panel : heading in ``--help``
    help : what the option does
    flag : spelling on the command line
    metavar : what ``--help`` shows for the value, where the name of its type says too little
    in_batch : whether the command ``batch`` has it
    limits : range of its values in words, where the help text does not name the values
    unset : what holds where the default is None
    choices : what a shell completes
    """

    name: str
    types: tuple[Any, ...]
    default: Any
    panel: Panel
    help: str
    flag: str
    metavar: str | None
    in_batch: bool
    limits: str
    unset: str
    choices: tuple[str, ...]

    @property
    def described(self) -> str:
        """The help text, followed by range and default."""
        if self.default is False:
            return self.help
        listed = ", ".join(self.default) if isinstance(self.default, tuple) else self.default
        default = self.unset if self.default in (None, ()) else f"{listed:,}" if self.limits else str(listed)
        return f"{self.help} [{'; '.join(part for part in (self.limits, f'default: {default}') if part)}]"


def _row(
    default: Any,
    panel: Panel,
    help: str,
    *,
    flag: str | None = None,
    metavar: str | None = None,
    in_batch: bool = True,
    limits: str = "",
    unset: str = "off",
    choices: tuple[str, ...] = (),
) -> Any:
    entry: dict[str, Any] = {"panel": panel, "help": help, "flag": flag, "metavar": metavar, "in_batch": in_batch}
    entry |= {"limits": limits, "unset": unset, "choices": choices}
    return field(default=default, metadata=entry)


@dataclass(frozen=True)
class OptionTable:
    """The options as fields. Their order is that of the report and, within a panel, of ``--help``."""

    read_points: int = _row(
        2_000_000,
        Panel.POINTS,
        "Keep at most this many points while reading; larger scans are thinned by voxels.",
        limits="at least 1",
    )
    columns: str | None = _row(
        None,
        Panel.POINTS,
        "Names of the columns of a table in text or NPY, in order, such as x,y,z,nx,ny,nz,- where - skips one.",
        metavar="NAMES",
    )
    crop: tuple[str, ...] = _row(
        (),
        Panel.POINTS,
        "Keep points in the box xmin,ymin,zmin,xmax,ymax,zmax, in file units; if repeated, in any of the boxes.",
        metavar="BOX",
        unset="all points",
    )
    clip_plane: tuple[str, ...] = _row(
        (),
        Panel.POINTS,
        "Keep points with a x + b y + c z + d of at least 0, in file units; if repeated, points that satisfy all "
        "planes.",
        metavar="PLANE",
        unset="all points",
    )
    units: str | None = _row(
        None,
        Panel.POINTS,
        "Unit of the scan (um, mm, cm, m, km, in, ft); lengths may then have a unit, such as 2mm.",
        unset="unknown",
        choices=("um", "mm", "cm", "m", "km", "in", "ft"),
    )
    fraction: float | str | None = _row(
        None,
        Panel.POINTS,
        "Share of the points to keep, such as 0.2 or 20%.",
        limits="above 0, up to 1 or 100%",
        unset="1",
        metavar="SHARE",
    )
    max_points: int | None = _row(
        None, Panel.POINTS, "Keep at most this many points for the fit.", limits="at least 1", unset="all"
    )
    spacing: float | str | None = _row(
        None,
        Panel.POINTS,
        "Thin the points to this distance: in file units or, as 2s, in multiples of their spacing.",
        limits="above 0",
        metavar="LENGTH",
    )
    subsample: str = _row(
        "random",
        Panel.POINTS,
        "How points are chosen: random, voxel, poisson, farthest or curvature (more where the surface bends).",
        choices=("random", "voxel", "poisson", "farthest", "curvature"),
    )
    holdout: float | str | None = _row(
        None,
        Panel.POINTS,
        "Exclude this share of the points from the fit, such as 0.1 or 10%, and report their distances from its "
        "surface.",
        limits="between 0 and 1 or 100%",
        metavar="SHARE",
    )
    outliers: str = _row(
        "auto",
        Panel.POINTS,
        "Remove scattered points: auto (unless they are more than 5 %), on or off; or by another rule, statistical:2 "
        "(deviations) or radius:3s,4 (fewer than 4 others within 3 spacings).",
        choices=("auto", "on", "off"),
    )
    clusters: str = _row(
        "auto",
        Panel.POINTS,
        "Remove small clusters whose distance from the rest exceeds their size: auto, on or off, as above.",
        choices=("auto", "on", "off"),
    )
    smooth_scan: float | str | None = _row(
        None,
        Panel.POINTS,
        "Smooth the points by moving least squares over this width: in file units or, as 8s, in spacings.",
        metavar="WIDTH",
        limits="above 0",
    )
    orient: str = _row(
        "auto",
        Panel.POINTS,
        "Normals: auto (estimate missing ones, flip them where all point inward), given (keep them), signs (recompute "
        "their sides) or estimate (recompute them).",
        choices=("auto", "given", "signs", "estimate"),
    )
    attributes: str = _row(
        "auto",
        Panel.MESH,
        "What vertices carry: auto (all attributes of the points, and the distance to them), none, or names such as "
        "colors,intensity.",
        choices=("auto", "none"),
    )
    curvature: bool = _row(
        False,
        Panel.MESH,
        "Vertices carry mean_curvature, positive on a sphere, and gauss_curvature of the field, per file unit and "
        "squared file unit.",
    )
    uncertainty: bool = _row(
        False,
        Panel.MESH,
        "Vertices carry sigma, the standard deviation of their position along the normal, in file units.",
    )
    resolution: int | None = _row(
        None,
        Panel.MESH,
        "Cells along the longest side of the box.",
        limits="at least 16",
        unset="64 to 1,024, from the points' spacing and noise; 256 of a saved field",
    )
    edge_length: float | None = _row(
        None,
        Panel.MESH,
        "Choose the resolution by the mean length of the mesh's edges, in file units.",
        limits="above 0",
    )
    max_error: float | None = _row(
        None,
        Panel.MESH,
        "Refine the mesh, up to 1,024 cells, until 99.9 % of face centres and edge midpoints are this close to the "
        "fitted surface, in file units.",
        limits="above 0",
    )
    keep_handles: bool = _row(False, Panel.MESH, "Keep handles and tunnels that no points support.")
    trim: float | str | None = _row(
        None,
        Panel.MESH,
        "Cut off what is farther than this from all points that face the same way, in file units or, as 3s, in "
        "spacings; the mesh is then open.",
        limits="above 0",
        metavar="LENGTH",
    )
    open: bool | None = _row(
        None,
        Panel.MESH,
        "Leave the mesh open where the scan ends: cut off what is farther than 2 spacings, or --trim, from points that "
        "face the same way. By default, if the scan is a single sheet, such as terrain or a wall.",
        flag="--open/--no-open",
    )
    remesh: float | None = _row(
        None,
        Panel.MESH,
        "Remesh to nearly equilateral faces of this edge length, in file units.",
        metavar="LENGTH",
        limits="above 0",
    )
    adaptive: bool = _row(
        False, Panel.MESH, "With --remesh: shorter edges where the surface bends, down to an eighth of the length."
    )
    simplify: float | None = _row(
        None,
        Panel.MESH,
        "Remove vertices while the surface moves by at most this distance, in file units.",
        metavar="DISTANCE",
        limits="above 0",
    )
    faces: int | None = _row(None, Panel.MESH, "Reduce the mesh to this number of faces.", limits="at least 4")
    feature_angle: float = _row(
        30.0,
        Panel.MESH,
        "With --remesh, --simplify or --faces: angle between neighbouring faces, in degrees, from which an edge is "
        "kept sharp.",
        limits="5 to 90",
    )
    smooth: str | None = _row(
        None,
        Panel.FIT,
        "Penalise curvature: strain=1e-4 (lengths in radii) halves bumps 0.63 long and removes shorter ones.",
        metavar="strain=WEIGHT",
        limits="a weight above 0",
    )
    fill: str | None = _row(
        None,
        Panel.FIT,
        "Close holes by minimal surfaces, as soap films do, instead of continuing the surface's curvature.",
        metavar="minimal",
        choices=("minimal",),
    )
    prior: str | None = _row(
        None,
        Panel.FIT,
        "Prefer surfaces that unroll into a plane between sharp edges, as bent sheet metal does.",
        metavar="developable",
        choices=("developable",),
    )
    widths: tuple[int, ...] | None = _row(
        None,
        Panel.FIT,
        "Fit one sine network with these hidden layers by Gauss-Newton, such as 2000 or 32,32,32.",
        limits="each at least 1",
        unset="a global field with local corrections",
        metavar="WIDTHS",
    )
    steps: int | None = _row(
        None,
        Panel.FIT,
        "Fit one network with at most this many steps after its linear start. The default for one network: gn 4 (none "
        "below 1,000 points; 120 for several layers), adam 2,000, lbfgs 40.",
        limits="at least 0",
        unset="by the network",
    )
    quality: str = _row(
        "normal",
        Panel.FIT,
        "Time against accuracy: draft, normal or high set the number of local features; draft fits no network.",
        choices=("draft", "normal", "high"),
    )
    normal_residual: str = _row(
        "vector",
        Panel.FIT,
        "Residual of the normals: vector, projection, cosine, or one from a plug-in. All but vector fit one network.",
        choices=("vector", "projection", "cosine"),
    )
    optimiser: str = _row(
        "gn",
        Panel.FIT,
        "gn (Gauss-Newton), or the paper's baselines, adam (cosine schedule) and lbfgs, which fit one network.",
        choices=("gn", "adam", "lbfgs"),
    )
    solver: str = _row(
        "auto",
        Panel.FIT,
        "Linear solver of Gauss-Newton's steps: auto (by rows, parameters, memory and device), cholesky, qr, "
        "row-space, cg-sampled, cg-neighbours, cg-kronecker, cg-nystrom, cg-block-jacobi, cg-jacobi, gmres or "
        "sketched; of one network alone, as the default fit has its own.",
        choices=(
            "auto",
            "cholesky",
            "qr",
            "row-space",
            "cg-sampled",
            "cg-neighbours",
            "cg-kronecker",
            "cg-nystrom",
            "cg-block-jacobi",
            "cg-jacobi",
            "gmres",
            "sketched",
        ),
    )
    search: str = _row(
        "auto",
        Panel.FIT,
        "Step control of Gauss-Newton: damping (by gain ratio), geodesic (the same, with geodesic acceleration), line "
        "(log-spaced step lengths) or auto; of one network alone, as the default fit has its own.",
        choices=("auto", "damping", "geodesic", "line"),
    )
    seed: int = _row(0, Panel.FIT, "Seed of all random choices.", limits="at least 0")
    device: str = _row(
        "cpu", Panel.FIT, "Where the fit and the mesh are computed: cpu or cuda.", choices=("cpu", "cuda")
    )
    threads: int | None = _row(None, Panel.FIT, "CPU threads.", limits="at least 1", unset="torch's choice")
    work_dir: str | None = _row(
        None,
        Panel.FIT,
        "Save the progress of the fit here, solved by blocks, so that the same run continues after it was killed.",
        metavar="FOLDER",
        in_batch=False,  # it serves one scan
    )
    block_scheduler: str | None = _row(
        None,
        Panel.FIT,
        "Dask cluster whose workers solve the blocks of --work-dir, such as tcp://host:8786; they must see the folder "
        "by the same path.",
        flag="--scheduler",
        metavar="ADDRESS",
        in_batch=False,  # it needs a work folder; a batch has a --scheduler of its own, which shares out scans
    )


@cache
def option_rows() -> dict[str, OptionRow]:
    """Return the rows of the table by name, in its order."""
    hints = get_type_hints(OptionTable)
    return {
        option.name: OptionRow(
            option.name,
            value_types(hints[option.name]),
            option.default,
            **{**option.metadata, "flag": option.metadata["flag"] or f"--{option.name.replace('_', '-')}"},
        )
        for option in fields(OptionTable)
    }


def option_documentation() -> str:
    """Return the rows as the ``Parameters`` section of a docstring."""
    hints = OptionTable.__annotations__
    rows = [f"{row.name} : {hints[row.name]}\n        {row.described}" for row in option_rows().values()]
    return "\n    ".join(["Parameters", "----------", *rows])
