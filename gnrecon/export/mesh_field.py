"""From a fitted field to a mesh in file units: extract, drop what no data supports, project, refine, repair, cut.

A reconstruction and `gnrecon mesh`, which meshes a saved field again, both do their meshing here.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from gnrecon.export import SignedDistance, curvatures, extract, project, refine, remove_handles, remove_stray, repair
from gnrecon.export.mesh_options import MeshOptions
from gnrecon.export.project import sdf_and_gradient
from gnrecon.export.resolution import (
    MOST_REFINED,
    Fineness,
    measure_fineness,
    projected_chord_error,
    refined_resolution,
)
from gnrecon.fit import NeuralSDF
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.mesh import Mesh
from gnrecon.runtime.progress import ProgressCallback, ignore_progress, part

_log = logging.getLogger(__name__)

SAFE = 0.95
"""Share of the wanted chord error at which a mesh is fine enough: projected as a whole, it may differ a little."""

MOST_SHIFTED, MOST_TILTED = 0.2, 1e-3
"""Errors of single precision that are put up with: in cells, and of gradients, as a share of themselves."""

CHORD = 0.07
"""Mean distance of a mesh's faces from the surface, over its curvature and the square of a cell: 0.072 on spheres."""

MOST_SMOOTH, ASKED = 224, 2000
"""Most cells that a smooth shape gets for its faces' sake, and points at which its curvature is asked for."""

StageTimer = Callable[[str], AbstractContextManager[None]]
"""Gives the context in which a stage of a name runs, such as `gnrecon.report.report.Stages`."""


def untimed(name: str) -> AbstractContextManager[None]:
    """Run a stage without timing it."""
    del name
    return nullcontext()


class MeshedField(SignedDistance, Protocol):
    """A field that can also be had in single precision, which is several times as fast."""

    def single(self) -> SignedDistance:
        """Return the same field in single precision."""
        ...


def cells_for_curvature(sdf: NeuralSDF, cells: int) -> int:
    """Return the cells, or up to 224 so that faces are no farther off the surface than the field itself may be.

    How much of the shape the smooth global field leaves over to the detail at the data tells how far it is off between
    them at most. That is far more than faces are off, but on smooth shapes that were scanned without noise.
    """
    data = sdf.data
    if sdf.detail is None or data is None or cells >= MOST_SMOOTH:
        return cells
    some = data[:: max(1, len(data) // ASKED)]
    off = float(np.sqrt(np.mean(sdf.coarse().sdf(some) ** 2)))
    mean, gauss = curvatures(sdf.gradient(some), sdf.hessian(some))
    bend = float(np.nanmean(np.sqrt((4 * mean**2 - 2 * gauss).clip(0.0))))
    longest = float(np.ptp(sdf.bounds, axis=0).max())
    # off = CHORD bend (longest / wanted)^2
    wanted = longest * np.sqrt(CHORD * bend / max(off, np.finfo(np.float64).tiny))
    return int(np.clip(np.ceil(wanted), cells, MOST_SMOOTH))


@dataclass(frozen=True)
class Meshed:
    """What became of a field.

    Parameters
    ----------
    mesh : Mesh
        Closed, with normals; `gnrecon.export.require_sound` has accepted it.
    fineness : Fineness
    actions : list of str
        A sentence for each thing that was dropped, refined, repaired or cut, and for what was asked of the fineness.
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
) -> Meshed:
    """Mesh the zero level of a field as the options ask.

    Parameters
    ----------
    field : MeshedField
    options : MeshOptions
    data : array of shape (N, 3), file units, or None
        Points that the field was fitted to, which tell surface from sheets and handles that were invented; with None
        all is kept.
    bounds : array of shape (2, 3), file units, optional
        The box to mesh in; by default the field's own.
    stages : callable
        Times the stages ``extract``, ``project``, ``refine`` where the options ask for it, and ``repair``.
    advance : callable
        Told of the share that is done of each stage.

    Raises
    ------
    UsageError
        When an edge length would need too few or too many cells.
    MeshError
        When there is no zero level in the box, or no sound mesh can be made of it.
    """
    box = field.bounds if bounds is None else bounds
    with stages("extract"):
        mesh, fast, cells, dropped = _extract_until_accurate(field, options, data, box, advance)
    with stages("project"):
        mesh = project(mesh, field, steps=2, rough=None if fast is field else fast, advance=advance)
    _log.info("Extracted %d vertices and %d faces with %d cells.", len(mesh.vertices), len(mesh.faces), cells)
    refined: list[str] = []
    if options.refine.anything:
        with stages("refine"):
            mesh, refined = refine(mesh, field, options.refine, advance=advance)
    with stages("repair"):
        mesh, repaired = repair(mesh)
        cut: list[str] = []
        if data is not None and not options.keep_handles:
            mesh, cut = remove_handles(mesh, data)
        fineness = measure_fineness(mesh, field, cells, box)
    return Meshed(mesh, fineness, [*dropped, *refined, *repaired, *cut, *_resolution_sentences(fineness, options)])


def _extract_until_accurate(
    field: MeshedField, options: MeshOptions, data: Float | None, box: Float, advance: ProgressCallback
) -> tuple[Mesh, SignedDistance, int, list[str]]:
    """Extract, and again with more cells until the error is small enough.

    Returns the field that was good enough for it, the cells, and what was dropped.
    """
    cells, begin = options.cells(box), 0.0
    while True:
        # How often is not known before: each attempt gets half of what is left of the stage.
        end = 1.0 if options.max_error is None else (begin + 1.0) / 2
        fast = field if data is None else _single_precision_field(field, data, cells)
        mesh = extract(fast, resolution=cells, bounds=box, data=data, advance=part(advance, begin, end))
        mesh, dropped = (mesh, []) if data is None else remove_stray(mesh, data)
        if options.max_error is None or cells >= MOST_REFINED:
            return mesh, fast, cells, dropped
        error = projected_chord_error(mesh, field, cells, box)
        if error <= SAFE * options.max_error:
            return mesh, fast, cells, dropped
        cells, begin = min(refined_resolution(cells, error, SAFE * options.max_error), MOST_REFINED), end


def _resolution_sentences(fineness: Fineness, options: MeshOptions) -> list[str]:
    """Tell what became of an edge length or a greatest error that was asked for."""
    if options.edge_length is None and options.max_error is None:
        return []
    said = [fineness.describe()]
    if options.max_error is not None and fineness.chord_error > options.max_error:
        reason = f": the limit of {MOST_REFINED} cells was reached." if fineness.resolution >= MOST_REFINED else "."
        said.append(f"That is not within {options.max_error:g}{reason}")
    return said


def _single_precision_field(field: MeshedField, data: Float, resolution: int) -> SignedDistance:
    """Return the field in single precision where vertices and normals come out well enough by it; projection by the
    field's own values makes the vertices exact.

    Features of high frequency with large weights cancel, so the errors are measured and not assumed.
    """
    some = data[:: max(1, len(data) // 2000)]
    single = field.single()
    value, gradient = sdf_and_gradient(field, some)
    rough, slanted = sdf_and_gradient(single, some)
    cell = np.ptp(field.bounds, axis=0).max() / resolution
    shifted = np.abs(rough - value).max() / cell
    tilted = (np.linalg.norm(slanted - gradient, axis=1) / np.linalg.norm(gradient, axis=1)).max()
    return single if shifted < MOST_SHIFTED and tilted < MOST_TILTED else field
