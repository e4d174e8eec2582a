"""The options that several commands share: what each is called, what it takes, and what its help says."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

POINTS, FIT, MESH, OUTPUT, DESIGN, BATCH = "Points", "Fit", "Mesh", "Output", "Design", "Batch"

Format = Annotated[
    str | None,
    typer.Option(help="How the scan is read, such as ply; by default as its extension says.", rich_help_panel=POINTS),
]
ReadPoints = Annotated[
    int,
    typer.Option(
        help="Most points to keep while reading; larger scans are thinned by voxels on the way.", rich_help_panel=POINTS
    ),
]
Crop = Annotated[
    list[str],
    typer.Option(
        metavar="BOX",
        help="Box to keep: xmin,ymin,zmin,xmax,ymax,zmax in file units; given again, points in any of the boxes stay.",
        rich_help_panel=POINTS,
    ),
]
ClipPlane = Annotated[
    list[str],
    typer.Option(
        metavar="PLANE",
        help="Plane a,b,c,d in file units: points with a x + b y + c z + d below 0 are dropped; may be given again.",
        rich_help_panel=POINTS,
    ),
]
Units = Annotated[
    str | None,
    typer.Option(
        help="The scan's own unit (um, mm, cm, m, km, in, ft), for lengths with a suffix.", rich_help_panel=POINTS
    ),
]
Fraction = Annotated[
    float | None, typer.Option(help="Share of the points to keep, above 0 and up to 1.", rich_help_panel=POINTS)
]
MaxPoints = Annotated[int | None, typer.Option(help="Most points to keep.", rich_help_panel=POINTS)]
Spacing = Annotated[
    str | None,
    typer.Option(
        help="Distance between points to thin to: in file units or, as 2s, in multiples of their own.",
        rich_help_panel=POINTS,
    ),
]
Subsample = Annotated[
    str,
    typer.Option(
        help="How they are chosen: random, voxel, poisson, farthest or curvature (more where the surface bends).",
        rich_help_panel=POINTS,
    ),
]
Holdout = Annotated[
    float | None,
    typer.Option(
        help="Share of the points that the fit does not see, such as 0.1; their distances from its surface are told.",
        rich_help_panel=POINTS,
    ),
]
Outliers = Annotated[
    str,
    typer.Option(
        help="Remove scattered points: auto (unless more than 5 % would go), on or off; or by another rule, "
        "statistical:2 (deviations) or radius:3s,4 (fewer than 4 others within 3 spacings).",
        rich_help_panel=POINTS,
    ),
]
Clusters = Annotated[
    str,
    typer.Option(
        help="Remove small clusters that are farther from the rest than they are large: auto, on or off, as above.",
        rich_help_panel=POINTS,
    ),
]
SmoothScan = Annotated[
    str | None,
    typer.Option(
        metavar="WIDTH",
        help="Smooth the points by moving least squares over this width: in file units or, as 8s, in their spacings.",
        rich_help_panel=POINTS,
    ),
]
Orient = Annotated[
    str,
    typer.Option(
        help="Normals: auto (estimated where there are none, turned where they look inward), given (as they are), "
        "signs (their sides found anew) or estimate (all anew).",
        rich_help_panel=POINTS,
    ),
]
Widths = Annotated[
    str | None,
    typer.Option(
        help="Hidden layers of the sine network, such as 2000 or 32,32,32; chosen from the points when not given.",
        rich_help_panel=FIT,
    ),
]
Steps = Annotated[
    int | None,
    typer.Option(
        help="Steps after the start; by default, of gn, 4 (0 below 1,000 points; 120 for several layers), of adam "
        "2,000, of lbfgs 40.",
        rich_help_panel=FIT,
    ),
]
Quality = Annotated[
    str,
    typer.Option(
        help="Time against accuracy: draft, normal or high; how much detail a part of the surface may have.",
        rich_help_panel=FIT,
    ),
]
Smooth = Annotated[
    str | None,
    typer.Option(
        metavar="strain=WEIGHT",
        help="Let the surface be smooth: strain=1e-4 (all in radii) halves bumps 0.63 long, and removes shorter ones.",
        rich_help_panel=FIT,
    ),
]
Fill = Annotated[
    str | None,
    typer.Option(
        metavar="minimal",
        help="Close holes by minimal surfaces, as soap films do, instead of as the rest bends.",
        rich_help_panel=FIT,
    ),
]
Prior = Annotated[
    str | None,
    typer.Option(
        metavar="developable",
        help="Let the surface be developable between creases, as sheet metal is: bent in one direction at most.",
        rich_help_panel=FIT,
    ),
]
NormalResidual = Annotated[
    str,
    typer.Option(
        help="Residual of the normals: vector, projection, cosine, or one that another package brings.",
        rich_help_panel=FIT,
    ),
]
Optimiser = Annotated[
    str,
    typer.Option(
        help="gn (Gauss-Newton), or what the paper compares it with: adam (cosine schedule) or lbfgs.",
        rich_help_panel=FIT,
    ),
]
Solver = Annotated[
    str,
    typer.Option(
        help="Linear solver of Gauss-Newton's steps: auto (by rows, parameters, memory and device), cholesky, qr, "
        "row-space, cg-sampled, cg-neighbours, cg-kronecker, cg-nystrom, cg-block-jacobi, cg-jacobi, gmres or "
        "sketched.",
        rich_help_panel=FIT,
    ),
]
SearchOption = Annotated[
    str,
    typer.Option(
        "--search",
        help="Step control of Gauss-Newton: damping (gain ratio), geodesic (the same, with steps that bend), line "
        "(log-spaced lengths) or auto.",
        rich_help_panel=FIT,
    ),
]
Seed = Annotated[int, typer.Option(help="Seed of everything random.", rich_help_panel=FIT)]
Device = Annotated[str, typer.Option(help="cpu or cuda.", rich_help_panel=FIT)]
Threads = Annotated[int | None, typer.Option(help="CPU threads; torch's choice when not given.", rich_help_panel=FIT)]
WorkDir = Annotated[
    str | None,
    typer.Option(
        metavar="FOLDER",
        help="Keep the work of the fit here, solved by blocks, so that the same run takes it up again after a kill.",
        rich_help_panel=FIT,
    ),
]
BlockScheduler = Annotated[
    str | None,
    typer.Option(
        "--scheduler",
        metavar="ADDRESS",
        help="A Dask cluster whose workers solve the blocks of --work-dir, such as tcp://host:8786.",
        rich_help_panel=FIT,
    ),
]
Resolution = Annotated[
    int | None,
    typer.Option(
        help="Cells along the longest side of the box; at least 16, by default 128 to 1,024 by the points' spacing.",
        rich_help_panel=MESH,
    ),
]
EDGE_LENGTH_HELP = "Mean length of the mesh's edges, in file units, instead of a resolution."
MAX_ERROR_HELP = (
    "Make the mesh finer, up to 1,024 cells, until 99.9 % of face centres and edge midpoints lie so near to the fitted "
    "surface, in file units."
)
EdgeLength = Annotated[float | None, typer.Option(help=EDGE_LENGTH_HELP, rich_help_panel=MESH)]
MaxError = Annotated[float | None, typer.Option(help=MAX_ERROR_HELP, rich_help_panel=MESH)]
Attributes = Annotated[
    str,
    typer.Option(
        help="What vertices carry: auto (all that the scan's points do, and their distance), none, or names such as "
        "colors,intensity.",
        rich_help_panel=MESH,
    ),
]
Output = Annotated[
    Path,
    typer.Option("-o", "--output", help="Mesh to write: .obj, .ply, .stl, .off, .glb or .3mf.", rich_help_panel=OUTPUT),
]
Curvature = Annotated[
    bool,
    typer.Option(
        "--curvature", help="Vertices carry the field's mean and Gauss curvature as well.", rich_help_panel=MESH
    ),
]
Trim = Annotated[
    str | None,
    typer.Option(
        help="Cut off what is farther from all points than this, in file units or, as 3s, in their spacings; leaves "
        "the mesh open.",
        rich_help_panel=MESH,
    ),
]
UncertaintyOption = Annotated[
    bool,
    typer.Option(
        "--uncertainty",
        help="Let vertices carry sigma, the standard deviation of their position along the normal, in file units.",
        rich_help_panel=MESH,
    ),
]
KeepHandles = Annotated[
    bool,
    typer.Option("--keep-handles", help="Keep handles and tunnels that no points support.", rich_help_panel=MESH),
]
Remesh = Annotated[
    float | None,
    typer.Option(
        metavar="LENGTH",
        help="Mesh anew with nearly equilateral faces of this edge length, in the scan's units.",
        rich_help_panel=MESH,
    ),
]
Adaptive = Annotated[
    bool,
    typer.Option(
        "--adaptive", help="With --remesh: shorter edges, down to an eighth, where it bends.", rich_help_panel=MESH
    ),
]
Simplify = Annotated[
    float | None,
    typer.Option(
        metavar="DISTANCE",
        help="Remove vertices while the surface moves by less than this, in the scan's units.",
        rich_help_panel=MESH,
    ),
]
Faces = Annotated[int | None, typer.Option(help="Reduce the mesh to this number of faces.", rich_help_panel=MESH)]
FeatureAngle = Annotated[
    float,
    typer.Option(
        help="With the three above: turn between neighbouring faces, in degrees, from which on an edge is kept sharp.",
        rich_help_panel=MESH,
    ),
]
Config = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="TOML file with options by their names, and tables of them for certain scans.",
        rich_help_panel=OUTPUT,
    ),
]
SetOption = Annotated[
    list[str],
    typer.Option(
        "--set", metavar="NAME=VALUE", help="An option as a word; may be given again.", rich_help_panel=OUTPUT
    ),
]
Overwrite = Annotated[
    bool, typer.Option("--overwrite", help="Replace files that exist; never the input.", rich_help_panel=OUTPUT)
]
Quiet = Annotated[bool, typer.Option("-q", "--quiet", help="Say nothing but failures.", rich_help_panel=OUTPUT)]
Verbose = Annotated[
    bool,
    typer.Option(
        "-v", "--verbose", help="Print choices, counts, and a line for each stage and step.", rich_help_panel=OUTPUT
    ),
]
Log = Annotated[
    Path | None,
    typer.Option(help="File to append a log to: all that -v prints and more, with times.", rich_help_panel=OUTPUT),
]
Debug = Annotated[bool, typer.Option("--debug", help="Show a traceback on failure.", rich_help_panel=OUTPUT)]
