"""The options of a reconstruction, checked before any work, and the options of its stages made from them."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from gnrecon.export import RefineOptions
from gnrecon.export.mesh_field import MeshOptions
from gnrecon.export.resolution import cells_for_sheet
from gnrecon.fit.blocks.block_parameters import BlockParameters
from gnrecon.fit.fit_options import FitOptions
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.point_cloud import Region
from gnrecon.geometry.units import METRES, parse_box, parse_plane, parse_reach, parse_share
from gnrecon.ingest import parse_outliers, require_mode
from gnrecon.ingest.orientation import require_orientation
from gnrecon.ingest.point_spacing import neighbour_spacing
from gnrecon.io import parse_columns
from gnrecon.option_table import OptionTable, option_documentation, option_rows
from gnrecon.runtime.errors import UsageError, suggestion
from gnrecon.runtime.typed_values import most_threads, require_at_most, require_field_types, shortened


@dataclass(frozen=True)
class Options(OptionTable):
    """Options of `gnrecon.reconstruct` and of the command line, checked.

    docs/options.md explains them with examples. Lengths are in file units; as text they may have another unit, as in
    ``"2mm"``, or be in spacings of the points, as in ``"2s"``. A value out of its range raises `UsageError`.
    """

    def __post_init__(self) -> None:
        for name in ("crop", "clip_plane"):
            object.__setattr__(self, name, _as_texts(getattr(self, name)))
        require_field_types(self)
        for name in ("fraction", "holdout"):
            if (share := getattr(self, name)) is not None:
                object.__setattr__(self, name, parse_share(name, share))
        self.region()
        self.column_names()
        parse_outliers(self.outliers, self.units)
        require_mode(self.clusters)
        self.mesh()
        self._require_valid_values()
        if self.trim_at(spacing=1.0) is not None and self.open is False:
            raise UsageError("Trimming leaves the mesh open. Give only one of --trim and --no-open.")
        for length in (self.spacing, self.smooth_scan):
            if length is not None:
                parse_reach(str(length), 1.0, self.units)
        if self.holdout == 1:
            raise UsageError(f"The share of points to hold out is {self.holdout}, but must lie between 0 and 1.")
        require_orientation(self.orient)
        self._require_block_options()

    def _require_bounded(
        self,
        *,
        most_cells: int = 16_384,
        most_count: int = 2**48,
        most_seed: int = 2**63 - 1,
        most_length: float = 1e30,
        least_length: float = 1e-30,
    ) -> None:
        """Refuse numbers that no machine can serve.

        Parameters
        ----------
        most_cells : along a side; coordinates of the nodes are packed into 64 bits
        most_count : of points, faces and steps
        most_seed : what all generators take
        most_length, least_length : in file units; squares and cubes of other lengths under- or overflow
        """
        counts = ("read_points", "max_points", "faces", "steps")
        most = dict.fromkeys(counts, most_count) | {"resolution": most_cells, "seed": most_seed}
        require_at_most(self, most | {"threads": most_threads()})
        for name in ("edge_length", "max_error", "remesh", "simplify"):
            value = getattr(self, name)
            if value is not None and not least_length <= value <= most_length:
                raise UsageError(
                    f"{name} must lie between {least_length:g} and {most_length:g}, not {shortened(value)}."
                )

    def _require_valid_values(self) -> None:
        self._require_bounded()
        if self.threads is not None and self.threads < 1:
            raise UsageError(f"The number of threads must be positive, not {self.threads}.")
        if self.read_points < 1:
            raise UsageError(f"The number of points to keep while reading must be positive, not {self.read_points}.")
        if self.units is not None and self.units not in METRES:
            raise UsageError(f"The scan's unit must be one of {', '.join(METRES)}, not {self.units!r}.")
        if self.seed < 0:
            raise UsageError(f"The seed must not be negative, not {self.seed}.")
        if not all(name.strip() for name in self.attributes.split(",")):
            raise UsageError(f"The attributes are auto, none or names separated by commas, not {self.attributes!r}.")

    def _require_block_options(self) -> None:
        if self.work_dir is not None and not self.fit().adaptive:
            raise UsageError("A work folder is for the default fit only, not for one network (--widths, --steps).")
        if self.block_scheduler is not None and self.work_dir is None:
            raise UsageError("A scheduler needs a work folder that all its workers see (--work-dir).")
        self.fit()

    @classmethod
    def of(cls, **values: Any) -> Options:
        """Return options from names and values.

        Raises
        ------
        UsageError
            When a name is unknown.
        """
        known = option_rows()
        for name in values:
            if name not in known:
                raise UsageError(f"There is no option {name!r}{suggestion(name, known)}.")
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
        """Return the region whose points are read.

        Raises
        ------
        UsageError
            When a text is not a box or a plane.
        """
        return Region(tuple(map(parse_box, self.crop)), tuple(map(parse_plane, self.clip_plane)))

    def column_names(self) -> tuple[str, ...]:
        """Return the names of a table's columns; none where they are found out.

        Raises
        ------
        UsageError
            When x, y or z is missing.
        """
        return parse_columns(self.columns)

    def trim_at(self, spacing: float, sheet: bool = False, *, open_reach_spacings: float = 2.0) -> float | None:
        """Return the distance beyond which the surface is cut off, in the unit of the points' spacing.

        Parameters
        ----------
        spacing : of the points
        sheet : whether the scan is a single sheet, which is left open unless the options say otherwise
        open_reach_spacings : the distance where the mesh is to be open and no other was given

        Raises
        ------
        UsageError
            When it is not a positive length.
        """
        if self.trim is not None:
            return parse_reach(str(self.trim), spacing, self.units)
        return open_reach_spacings * spacing if (sheet if self.open is None else self.open) else None

    def for_scan(
        self, points: Float, bounds: Float, sheet: float | None = None, *, most_sheet_cells: int = 512
    ) -> Options:
        """Return the options with a resolution that suits a scan where none was given.

        Parameters
        ----------
        points : array of shape (N, 3), file units, that will be fitted
        bounds : box in which they will be meshed, of shape (2, 3), file units
        sheet : thickness of the thinnest sheet that they show, file units, if there is one
        most_sheet_cells : along the box for its sake
        """
        if self.resolution is not None or self.edge_length is not None:
            return self
        longest = float(np.ptp(bounds, axis=0).max())
        cells = _default_cells(longest, points)
        thin = cells if sheet is None else cells_for_sheet(longest, sheet)
        return replace(self, resolution=max(cells, thin if thin <= most_sheet_cells else cells))

    def require_reachable(self, bounds: Float, *, most_faces: float = 1e8, least_error: float = 1e-7) -> None:
        """Refuse lengths for which the mesh would not fit into memory, before the work.

        Parameters
        ----------
        bounds : box in which the points will be meshed, of shape (2, 3), file units
        most_faces : with `remesh`, of a surface as large as that of the box; a hundred bytes and more for each
        least_error : of `max_error` and `simplify`, in longest sides of the box: half of what 1024 cells leave on balls

        Raises
        ------
        UsageError
            With the least length.
        """
        x, y, z = np.ptp(bounds, axis=0)
        self.mesh().cells(bounds)  # refuses an edge length for which there would be too many
        if self.remesh is not None:
            # Faces of an equilateral mesh have an area of sqrt(3) / 4 of their squared edge.
            least = math.sqrt(2 * (x * y + y * z + z * x) / (most_faces * math.sqrt(3) / 4))
            if self.remesh < least:
                raise UsageError(
                    f"Faces with edges of {self.remesh:g} would be more than {most_faces:,.0f} on this scan; "
                    f"give --remesh at least {least:.2g}."
                )
        least = least_error * max(x, y, z)
        for option, length in (("max-error", self.max_error), ("simplify", self.simplify)):
            if length is not None and length < least:
                raise UsageError(
                    f"No mesh is as near to the surface as {length:g}; give --{option} at least {least:.2g}."
                )

    def fit(self) -> FitOptions:
        """Return the options of the fit."""
        return FitOptions(
            widths=self.widths,
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


Options.__doc__ = f"{Options.__doc__}\n    {option_documentation()}"


def _default_cells(
    longest: float,
    points: Float,
    *,
    sparse_cell_spacings: float = 1 / 3,
    sparse_cells: tuple[int, int] = (128, MeshOptions.default_cells),
    dense_cell_spacings: float = 1.5,
    dense_cells: tuple[int, int] = (MeshOptions.default_cells, 1024),
) -> int:
    """The cells along the longest side of the box where neither a resolution nor an edge length was given.

    Parameters
    ----------
    longest : side of the box, file units
    points : of shape (N, 3), file units
    sparse_cell_spacings : cell edge of a scan that is fitted in one piece, in spacings of its points: fine enough for
        faces to follow the field between the points
    sparse_cells : range of its cells
    dense_cell_spacings : cell edge of a scan that is fitted by blocks: about one vertex for each point
    dense_cells : range of its cells
    """
    dense = len(points) >= BlockParameters.large_scan_points
    edge = (dense_cell_spacings if dense else sparse_cell_spacings) * neighbour_spacing(points)
    least, most = dense_cells if dense else sparse_cells
    return math.ceil(min(max(longest / edge, least), most)) if edge > 0 else most


def _as_texts(value: Any) -> Any:
    """Return boxes or planes as texts, where one may be given as it is, and each as numbers; others as they are."""
    if isinstance(value, str):
        return (value,)
    try:
        rows = np.asarray(value)
    except ValueError:  # rows of different lengths
        return value
    if rows.ndim not in (1, 2) or not rows.size or rows.dtype.kind not in "iuf":
        return value
    return tuple(",".join(map(str, row)) for row in np.atleast_2d(rows).tolist())
