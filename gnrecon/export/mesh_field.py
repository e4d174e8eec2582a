"""Meshes a fitted field in file units: extract, drop unsupported parts, project, refine, repair, remove handles.

`mesh_field` does the meshing of a reconstruction and of `gnrecon mesh`, which meshes a saved field again; `MeshOptions`
says how.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from gnrecon.export import SignedDistance, curvatures, extract, project, refine, remove_handles, repair
from gnrecon.export.components import Supported, bridge, supported_components
from gnrecon.export.export_parameters import ExportParameters
from gnrecon.export.remeshing.refine import RefineOptions
from gnrecon.export.resolution import (
    Fineness,
    cells_for_edges,
    cells_for_sheet,
    measure_fineness,
    projected_chord_error,
    refined_resolution,
)
from gnrecon.fit import NeuralSDF
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.mesh import Mesh
from gnrecon.ingest.point_spacing import neighbour_spacing
from gnrecon.runtime.errors import UsageError
from gnrecon.runtime.progress import ProgressCallback, ignore_progress, subrange

_log = logging.getLogger(__name__)

StageTimer = Callable[[str], AbstractContextManager[None]]
"""Returns the context in which a named stage runs, such as `gnrecon.report.report.Stages`."""


def untimed(name: str) -> AbstractContextManager[None]:
    """Run a stage without timing it."""
    del name
    return nullcontext()


class MeshedField(SignedDistance, Protocol):
    """A field that also has a version in single precision, which is several times as fast."""

    def single(self) -> SignedDistance:
        """Return the same field in single precision."""
        ...


@dataclass(frozen=True)
class MeshOptions:
    """Options of `mesh_field`.

    Parameters
    ----------
    resolution : int, optional
        Cells along the longest side of the box; by default `default_cells`.
    edge_length : float, file units, optional
        Mean length of the mesh's edges, from which the number of cells follows.
    max_error : float, file units, optional
        Distance from the field's surface that 99.9 % of face centres and edge midpoints stay within; the mesh is made
        finer until they do, up to 1,024 cells.
    keep_handles : bool
        Whether handles and tunnels without supporting points stay, see `gnrecon.export.remove_handles`.
    refine : RefineOptions
        Remeshing and decimation.
    default_cells : int
        Cells where neither a resolution nor an edge length is given.

    Raises
    ------
    UsageError
        When a value is out of its range.
    """

    resolution: int | None = None
    edge_length: float | None = None
    max_error: float | None = None
    keep_handles: bool = False
    refine: RefineOptions = field(default_factory=RefineOptions)
    default_cells: int = 256

    def __post_init__(self) -> None:
        if self.resolution is not None and self.edge_length is not None:
            raise UsageError("An edge length sets the resolution. Give only one of the two.")
        least = ExportParameters.resolution.least_cells
        if self.resolution is not None and self.resolution < least:
            raise UsageError(f"The resolution must be at least {least} cells, not {self.resolution}.")
        for name, value in (("edge length", self.edge_length), ("greatest error", self.max_error)):
            if value is not None and not 0 < value < math.inf:
                raise UsageError(f"The {name} must be a positive length, not {value:g}.")

    def cells(self, bounds: Float) -> int:
        """Return the cells along the longest side of a box, of shape (2, 3) in file units, to begin with.

        Raises
        ------
        UsageError
            When the edge length would need too few or too many.
        """
        if self.edge_length is not None:
            return cells_for_edges(self.edge_length, bounds)
        return self.resolution or self.default_cells


def cells_for_faces(
    sdf: NeuralSDF,
    cells: int,
    sheet: float | None = None,
    points: int | None = None,
    *,
    least_cells: int = 64,
    least_spacing_cells: float = 1.5,
    most_cells: int = 224,
    samples: int = 2000,
    chord_ratio: float = 0.07,
    error_share: float = 0.7,
) -> int:
    """Return the cells that the faces need: more for a smooth shape without noise, fewer where noise hides the gain.

    The amplitude of the detail field at the data bounds the error of the smooth global field between them. It is far
    more than the distance of the faces, except on smooth shapes that were scanned without noise. Noise of the points
    leaves the field an error of about sigma / sqrt(n), with n points within a length scale; where faces are nearer to
    the field than a small share of that, finer ones bring them no nearer to the surface.

    Parameters
    ----------
    sdf : NeuralSDF
    cells : int
        That suit the spacing of the points.
    sheet : float, file units, optional
        Thickness of the thinnest sheet, which the cells resolve whatever the noise is.
    points : int, optional
        That were fitted, where the field keeps a random part of them; by default those that it keeps.
    least_cells, least_spacing_cells : int, float
        Least to return because of noise: of the whole box, and through a spacing of the points.
    most_cells : int
        Most to return for the sake of smooth faces.
    samples : int
        Most points at which the curvature is evaluated.
    chord_ratio : float
        Mean distance of faces from the surface over its curvature and the square of a cell; 0.072 on spheres.
    error_share : float
        Mean distance of faces from the field, over its error by noise, that is small enough: with twice as many faces,
        meshes were 0.5 to 2 % nearer to the truth.
    """
    data = sdf.data
    if sdf.detail is None or data is None:
        return cells
    longest, spacing = float(np.ptp(sdf.bounds, axis=0).max()), neighbour_spacing(data)
    if not spacing > 0:  # points that coincide say nothing
        return cells
    spacing *= math.sqrt(min(len(data) / (points or len(data)), 1.0))
    through = 0 if sheet is None else cells_for_sheet(longest, sheet)
    least = max(least_cells, math.ceil(least_spacing_cells * longest / spacing), through)
    if least >= cells >= most_cells:
        return cells
    some = data[:: max(1, len(data) // samples)]
    mean, gauss = curvatures(sdf.gradient(some), sdf.hessian(some))
    # sqrt(k1^2 + k2^2) from the mean and the Gauss curvature.
    bend = float(np.nanmean(np.sqrt((4 * mean**2 - 2 * gauss).clip(0.0))))

    def needed(off: float) -> int:
        """Return the cells for a mean distance: off = chord_ratio bend (longest / cells)^2."""
        least_off = chord_ratio * bend * (longest / ExportParameters.resolution.most_refined_cells) ** 2
        return math.ceil(longest * math.sqrt(chord_ratio * bend / max(off, least_off, np.finfo(np.float64).tiny)))

    per_length = np.sqrt(np.pi) * float(np.median(sdf.detail.lengths)) * sdf.frame.scale / spacing
    if (enough := needed(error_share * sdf.detail.position * sdf.frame.scale / per_length)) < cells:
        return min(max(enough, least), cells)
    if cells >= most_cells:
        return cells
    # The coarse field at the data is the detail that the smooth field does not represent.
    off = float(np.sqrt(np.mean(sdf.coarse().sdf(some) ** 2)))
    return min(max(needed(off), cells), most_cells)


@dataclass(frozen=True)
class Meshed:
    """A meshed field.

    Parameters
    ----------
    mesh : Mesh
        Closed, with normals; `gnrecon.export.require_sound` has accepted it.
    fineness : Fineness
    actions : list of str
        A sentence for each change, and for the fineness where an edge length or error was requested.
    """

    mesh: Mesh
    fineness: Fineness
    actions: list[str]


def mesh_field(
    field: MeshedField,
    options: MeshOptions,
    *,
    data: Float | None,
    bounds: Float | None = None,
    stages: StageTimer = untimed,
    advance: ProgressCallback = ignore_progress,
    parameters: ExportParameters = ExportParameters(),
) -> Meshed:
    """Mesh the zero level of a field as the options ask.

    Parameters
    ----------
    field : MeshedField
    options : MeshOptions
    data : array of shape (N, 3), file units, or None
        Points that the field was fitted to. Components and handles that they do not support are removed; with None
        all are kept.
    bounds : array of shape (2, 3), file units, optional
        The box to mesh in; by default the field's own.
    stages : callable
        Times the stages ``extract``, ``project``, ``refine`` where the options ask for it, and ``repair``.
    advance : callable
        Receives the share of each stage that is done.
    parameters : ExportParameters

    Raises
    ------
    UsageError
        When an edge length would need too few or too many cells.
    MeshError
        When there is no zero level in the box, or no sound mesh can be made of it.
    """
    box = field.bounds if bounds is None else bounds
    with stages("extract"):
        (mesh, dropped, gaps), fast, cells = _extract_until_accurate(field, options, data, box, advance, parameters)
    # The first Newton step brings nearly all vertices so near to the zero level that it is no matter next to the faces.
    with stages("project"):
        tolerance = parameters.resolution.projection_tolerance
        rough = None if fast is field else fast
        # Rounding far below the tolerance is no matter, either; half an edge is about a third of a cell.
        exact: SignedDistance = field
        if rough is not None and data is not None and _rounding(field, rough, data, cells) <= tolerance / 4:
            exact, rough = rough, None
        mesh = project(mesh, exact, steps=2, rough=rough, tolerance=tolerance, advance=advance)
    _log.info("Extracted %d vertices and %d faces with %d cells.", len(mesh.vertices), len(mesh.faces), cells)
    refined: list[str] = []
    if options.refine.anything:
        with stages("refine"):
            mesh, refined = refine(mesh, field, options.refine, advance=advance, parameters=parameters.remesh)
    with stages("repair"):
        mesh, repaired = repair(mesh)
        # After the last Newton step, which would move a bridge to where the field is zero.
        mesh, bridged = (mesh, []) if data is None else bridge(mesh, gaps, data)
        cut: list[str] = []
        if data is not None and not options.keep_handles:
            mesh, cut = remove_handles(mesh, data, parameters=parameters.handles, known_sound=True)
        fineness = measure_fineness(mesh, exact, cells, box, parameters=parameters.resolution)
    sentences = _resolution_sentences(fineness, options, parameters.resolution.most_refined_cells)
    return Meshed(mesh, fineness, [*dropped, *refined, *repaired, *bridged, *cut, *sentences])


def _extract_until_accurate(
    field: MeshedField,
    options: MeshOptions,
    data: Float | None,
    box: Float,
    advance: ProgressCallback,
    parameters: ExportParameters,
) -> tuple[Supported, SignedDistance, int]:
    """Extract, and again with more cells until the error is small enough.

    Returns the components that stay, the field that was precise enough for them, and the cells.
    """
    cells, begin, most_cells = options.cells(box), 0.0, parameters.resolution.most_refined_cells
    while True:
        # The number of attempts is unknown: each gets half of what is left of the stage's progress.
        end = 1.0 if options.max_error is None else (begin + 1.0) / 2
        fast = field if data is None else _single_precision_field(field, data, cells)
        mesh = extract(
            fast,
            resolution=cells,
            bounds=box,
            data=data,
            advance=subrange(advance, begin, end),
            parameters=parameters.extraction,
        )
        # Before the error is measured, so that ghost sheets do not count.
        supported = supported_components(mesh, data, fast)
        if options.max_error is None or cells >= most_cells:
            return supported, fast, cells
        error = projected_chord_error(supported.mesh, field, cells, box, parameters=parameters.resolution)
        accepted = parameters.resolution.accepted_error_share * options.max_error
        if error <= accepted:
            return supported, fast, cells
        cells, begin = min(refined_resolution(cells, error, accepted), most_cells), end


def _resolution_sentences(fineness: Fineness, options: MeshOptions, most_cells: int) -> list[str]:
    """Sentences on an edge length or a greatest error that was requested."""
    if options.edge_length is None and options.max_error is None:
        return []
    sentences = [fineness.describe()]
    if options.max_error is not None and fineness.chord_error > options.max_error:
        reason = f": the limit of {most_cells} cells was reached." if fineness.resolution >= most_cells else "."
        sentences.append(f"That is not within {options.max_error:g}{reason}")
    return sentences


def _single_precision_field(
    field: MeshedField,
    data: Float,
    resolution: int,
    *,
    most_shift_cells: float = 0.2,
    most_gradient_error: float = 1e-3,
    samples: int = 2000,
) -> SignedDistance:
    """Return the field in single precision where that is accurate enough to extract with, else the field.

    Projection by the field's own values makes the vertices exact. Features of high frequency with large weights cancel,
    so that the errors are measured: at most `samples` points of `data`, values in cells of `resolution` along the box,
    and gradients relative to their length.
    """
    some = data[:: max(1, len(data) // samples)]
    single = field.single()
    gradient, single_gradient = field.gradient(some), single.gradient(some)
    gradient_error = (np.linalg.norm(single_gradient - gradient, axis=1) / np.linalg.norm(gradient, axis=1)).max()
    shift = _rounding(field, single, some, resolution)
    return single if shift < most_shift_cells and gradient_error < most_gradient_error else field


def _rounding(
    field: MeshedField, single: SignedDistance, data: Float, resolution: int, *, samples: int = 2000
) -> float:
    """Return the largest difference of both fields' values at some points, in cells; the error of single precision."""
    some = data[:: max(1, len(data) // samples)]
    cell = np.ptp(field.bounds, axis=0).max() / resolution
    return float(np.abs(single.sdf(some) - field.sdf(some)).max() / cell)
