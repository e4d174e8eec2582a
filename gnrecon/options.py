"""Everything a reconstruction can be asked for, checked once at the door."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import numpy as np

from gnrecon.export import RefineOptions
from gnrecon.export.mesh_field import MeshOptions
from gnrecon.fit.blocks.solve import LARGE
from gnrecon.fit.fit_options import FitOptions
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.point_cloud import Region
from gnrecon.geometry.units import METRES, parse_box, parse_plane, parse_reach
from gnrecon.ingest import parse_outliers, require_mode
from gnrecon.ingest.noise import neighbour_spacing
from gnrecon.ingest.orientation import require_orientation
from gnrecon.io import MOST_POINTS
from gnrecon.runtime.errors import UsageError

RESOLUTION, FEWEST_CELLS, MOST_CELLS = MeshOptions.default_cells, 128, 1024
"""Cells where nothing else is known; the fewest that a sparse scan and the most that a large one gets by itself."""

CELL_SPACINGS, SPARSE_CELL_SPACINGS = 1.5, 1 / 3
"""Edge of a cell, in spacings of a large scan's points: about one vertex for each of them; and of a sparse one's."""


@dataclass(frozen=True)
class Options:
    """Options of `gnrecon.reconstruct` and of the command line.

    Parameters
    ----------
    read_points : int
        Most points to keep of a scan while it is read: of a larger one, the first point in each of as many equal cubes
        stays, and memory does not grow with the file.
    crop : sequence of str
        Boxes ``"xmin,ymin,zmin,xmax,ymax,zmax"`` in file units; points outside of all of them are not read. A single
        box may be given as it is.
    clip_plane : sequence of str
        Planes ``"a,b,c,d"``; points with a x + b y + c z + d < 0 for any of them are not read.
    units : str, optional
        The scan's own unit, one of `gnrecon.geometry.units.METRES`; lengths may then have other units: ``"2mm"``.
    fraction : float in (0, 1], optional
        Share of the points to keep.
    max_points : int, optional
        Most points to keep.
    spacing : float or str, optional
        Distance between neighbouring points to thin to, in file units, in another unit as in ``"2mm"``, or as in
        ``"2s"`` in multiples of the distance that they have.
    subsample : ``"random"``, ``"voxel"``, ``"poisson"``, ``"farthest"`` or ``"curvature"``
        How the kept points are chosen, see `gnrecon.ingest.subsample`.
    holdout : float in (0, 1), optional
        Share of the points that the fit does not see; how far they lie from its surface is reported.
    outliers : str
        Whether scattered points are removed: ``"auto"`` leaves them when they are more than 5 % of all, ``"on"``,
        ``"off"``; ``"statistical:2"`` and ``"radius:3s,4"`` use other rules, see `gnrecon.ingest.outliers`.
    clusters : ``"auto"``, ``"on"`` or ``"off"``
        The same for small isolated clusters, see `gnrecon.ingest.clean`.
    smooth_scan : float or str, optional
        Width over which the points are smoothed by moving least squares before the fit, in file units, in another unit
        as in ``"2mm"``, or in spacings of the points as in ``"8s"``, see `gnrecon.ingest.smooth`.
    orient : ``"auto"``, ``"given"``, ``"signs"`` or ``"estimate"``
        Normals are estimated where the scan has none. Those that it has: ``"auto"`` turns all around where they look
        into a closed surface, ``"given"`` takes them as they are, ``"signs"`` finds the side of each anew and
        ``"estimate"`` discards them.
    attributes : str
        Of the vertices: ``"auto"`` carries over all that the scan holds of its points (colours, labels, measured
        values) and adds ``distance``, to the nearest of them; ``"none"``; or names of these, separated by commas.
    curvature : bool
        Whether vertices carry ``mean_curvature``, positive where the surface is convex as a sphere is, and
        ``gauss_curvature``, per file unit and per squared file unit.
    uncertainty : bool
        Whether vertices carry ``sigma``, the standard deviation of their position along the normal, see `Uncertainty`.
    resolution : int, optional
        Cells of the extraction along the longest side of the shape's box. Unless there is an edge length, as many as
        make a cell a third of the points' spacing, but from 128 to 256, or more, up to 224, where the faces of a smooth
        shape would else be farther off than its field; of 200,000 points or more, one and a half spacings, from 256 to
        1,024 cells.
    edge_length : float, file units, optional
        Mean length of the mesh's edges, from which the number of cells follows.
    max_error : float, file units, optional
        Distance from the field's surface that 99.9 % of face centres and edge midpoints are to stay within; the mesh is
        made finer until they do, up to 1,024 cells.
    keep_handles : bool
        Whether handles and tunnels that no points support stay, see `gnrecon.export.remove_handles`.
    trim : float or str, optional
        Distance from the nearest point beyond which the surface is cut off, in file units, in another unit as in
        ``"2mm"``, or in spacings of the points as in ``"3s"``; the mesh is then open. By default nothing is cut.
    remesh, adaptive, simplify, faces, feature_angle
        Of the mesh's refinement, see `gnrecon.export.RefineOptions`.
    smooth, fill, prior : str, optional
        What is asked of the surface besides lying near the points: ``"strain=1e-4"`` to be smooth, by the square of the
        principal curvatures with that weight, all in radii; ``"minimal"`` to close holes as a soap film would;
        ``"developable"`` to unroll into the plane, as sheet metal does. See `gnrecon.fit.regularisers`.
    widths, steps, quality, normal_residual, optimiser, solver, search, seed, device
        Of the fit, see `FitOptions`; `device` is ``"cpu"`` or ``"cuda"``.
    threads : int, optional
        CPU threads of the fit, and processes that solve the blocks of a large one; by default what torch chooses.
    work_dir : str, optional
        Folder in which the work of the fit is kept, so that a run that was killed is taken up again by the same one.
        The fit is then solved by blocks, as that of 200,000 points or more always is; see `gnrecon.fit.blocks.solve`.
    block_scheduler : str, optional
        Address of a Dask scheduler, such as ``"tcp://host:8786"``, whose workers solve the blocks; they must see the
        work folder by the same path.

    Raises
    ------
    UsageError
        When a name is unknown or a value out of its range.
    """

    read_points: int = MOST_POINTS
    crop: tuple[str, ...] = ()
    clip_plane: tuple[str, ...] = ()
    units: str | None = None
    fraction: float | None = None
    max_points: int | None = None
    spacing: float | str | None = None
    subsample: str = "random"
    holdout: float | None = None
    outliers: str = "auto"
    clusters: str = "auto"
    smooth_scan: float | str | None = None
    orient: str = "auto"
    attributes: str = "auto"
    curvature: bool = False
    uncertainty: bool = False
    resolution: int | None = None
    edge_length: float | None = None
    max_error: float | None = None
    keep_handles: bool = False
    trim: float | str | None = None
    remesh: float | None = None
    adaptive: bool = False
    simplify: float | None = None
    faces: int | None = None
    feature_angle: float = RefineOptions.feature_angle
    smooth: str | None = None
    fill: str | None = None
    prior: str | None = None
    widths: tuple[int, ...] | None = None
    steps: int | None = None
    quality: str = FitOptions.quality
    normal_residual: str = FitOptions.normals
    optimiser: str = FitOptions.optimiser
    solver: str = FitOptions.solver
    search: str = FitOptions.search
    seed: int = 0
    device: str = "cpu"
    threads: int | None = None
    work_dir: str | None = None
    block_scheduler: str | None = None

    def __post_init__(self) -> None:
        for name in ("crop", "clip_plane"):
            value = getattr(self, name)
            object.__setattr__(self, name, (value,) if isinstance(value, str) else tuple(value))
        self.region()
        parse_outliers(self.outliers, self.units)
        require_mode(self.clusters)
        self.mesh()
        if self.threads is not None and self.threads < 1:
            raise UsageError(f"The number of threads must be positive, not {self.threads}.")
        if self.read_points < 1:
            raise UsageError(f"The number of points to keep while reading must be positive, not {self.read_points}.")
        if self.units is not None and self.units not in METRES:
            raise UsageError(f"The scan's unit must be one of {', '.join(METRES)}, not {self.units!r}.")
        if self.seed < 0:
            raise UsageError(f"The seed must not be negative, not {self.seed}.")
        if self.widths is not None and not isinstance(self.widths, list | tuple):
            raise UsageError(f"The widths must be a sequence such as (2000,), not {self.widths!r}.")
        if not all(name.strip() for name in self.attributes.split(",")):
            raise UsageError(f"The attributes are auto, none or names separated by commas, not {self.attributes!r}.")
        self.trim_at(spacing=1.0)
        for length in (self.spacing, self.smooth_scan):
            if length is not None:
                parse_reach(str(length), 1.0, self.units)
        if self.holdout is not None and not 0 < self.holdout < 1:
            raise UsageError(f"The share of points to hold out is {self.holdout}, but must lie between 0 and 1.")
        require_orientation(self.orient)
        if self.work_dir is not None and not self.fit().adaptive:
            raise UsageError("A work folder serves the default fit alone, not one network (--widths, --steps).")
        if self.block_scheduler is not None and self.work_dir is None:
            raise UsageError("A scheduler's workers need a work folder that all of them see (--work-dir).")
        self.fit()

    @classmethod
    def of(cls, **values: Any) -> Options:
        """Return options from names and values.

        Raises
        ------
        UsageError
            When a name is unknown.
        """
        known = [option.name for option in fields(cls)]
        for name in values:
            if name not in known:
                raise UsageError(f"There is no option {name!r}; the options are {', '.join(known)}.")
        return cls(**values)

    def ingest(self) -> dict[str, Any]:
        """Return the arguments of `gnrecon.ingest.prepare`."""
        names = (
            "outliers",
            "clusters",
            "smooth_scan",
            "fraction",
            "max_points",
            "spacing",
            "subsample",
            "holdout",
            "orient",
            "units",
            "seed",
        )
        return {name: getattr(self, name) for name in names}

    def region(self) -> Region:
        """Return where points are wanted.

        Raises
        ------
        UsageError
            When a text is no box or no plane.
        """
        return Region(tuple(map(parse_box, self.crop)), tuple(map(parse_plane, self.clip_plane)))

    def trim_at(self, spacing: float) -> float | None:
        """Return the distance beyond which the surface is cut off, in the unit of the points' spacing.

        Raises
        ------
        UsageError
            When it is no positive length.
        """
        if self.trim is None:
            return None
        return parse_reach(str(self.trim), spacing, self.units)

    def for_scan(self, points: Float, bounds: Float) -> Options:
        """Return the options with the cells that a scan gets where none were asked for.

        Parameters
        ----------
        points : array of shape (N, 3), file units, that will be fitted
        bounds : box in which they will be meshed, of shape (2, 3), file units
        """
        if self.resolution is not None or self.edge_length is not None:
            return self
        longest = float(np.ptp(bounds, axis=0).max())
        dense = len(points) >= LARGE
        edge = (CELL_SPACINGS if dense else SPARSE_CELL_SPACINGS) * neighbour_spacing(points)
        least, most = (RESOLUTION, MOST_CELLS) if dense else (FEWEST_CELLS, RESOLUTION)
        return replace(self, resolution=math.ceil(min(max(longest / edge, least), most)) if edge > 0 else most)

    def fit(self) -> FitOptions:
        """Return the options of the fit."""
        return FitOptions(
            widths=None if self.widths is None else tuple(self.widths),
            steps=self.steps,
            quality=self.quality,
            normals=self.normal_residual,
            optimiser=self.optimiser,
            solver=self.solver,
            search=self.search,
            smooth=self.smooth,
            fill=self.fill,
            prior=self.prior,
            seed=self.seed,
            device=self.device,
        )

    def mesh(self) -> MeshOptions:
        """Return the options of the meshing."""
        return MeshOptions(
            resolution=self.resolution,
            edge_length=self.edge_length,
            max_error=self.max_error,
            keep_handles=self.keep_handles,
            refine=RefineOptions(self.remesh, self.adaptive, self.simplify, self.faces, self.feature_angle),
        )

    def as_dict(self) -> dict[str, Any]:
        """Return the options as plain values."""
        return asdict(self)
