"""From a fitted field to a mesh in file units: extract, drop what no data supports, project, repair.

A reconstruction and `gnrecon mesh`, which meshes a saved field again, both do their meshing here.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Protocol

import numpy as np

from gnrecon.advance import Advance, unheard
from gnrecon.cloud import Float
from gnrecon.export import SignedDistance, extract, project, remove_stray, repair
from gnrecon.mesh import Mesh
from gnrecon.options import Options

StageTimer = Callable[[str], AbstractContextManager[None]]
"""Gives the context in which a stage of a name runs, such as `gnrecon.report.Stages`."""


def untimed(name: str) -> AbstractContextManager[None]:
    """Run a stage without timing it."""
    del name
    return nullcontext()


class MeshedField(SignedDistance, Protocol):
    """A field that can also be had in single precision, which is several times as fast."""

    def single(self) -> SignedDistance:
        """Return the same field in single precision."""
        ...


def mesh_field(
    field: MeshedField,
    options: Options,
    *,
    data: Float | None,
    bounds: Float | None = None,
    stages: StageTimer = untimed,
    advance: Advance = unheard,
) -> tuple[Mesh, list[str]]:
    """Mesh the zero level of a field as the options ask.

    Parameters
    ----------
    field : MeshedField
    options : Options
    data : array of shape (N, 3), file units, or None
        Points that the field was fitted to, which tell surface from sheets that were invented; with None all is kept.
    bounds : array of shape (2, 3), file units, optional
        The box to mesh in; by default the field's own.
    stages : callable
        Times the stages ``extract``, ``project`` and ``repair``.
    advance : callable
        Told of the share that is done of each stage.

    Returns
    -------
    Mesh
        Closed, with normals; `gnrecon.export.require_sound` has accepted it.
    list of str
        A sentence for each thing that was dropped or repaired.

    Raises
    ------
    MeshError
        When there is no zero level in the box, or no sound mesh can be made of it.
    """
    with stages("extract"):
        coarse = field if data is None else _coarse(field, data, options.resolution)
        mesh = extract(coarse, resolution=options.resolution, bounds=bounds, data=data, advance=advance)
        mesh, dropped = (mesh, []) if data is None else remove_stray(mesh, data)
    with stages("project"):
        mesh = project(mesh, field, steps=2, advance=advance)
    with stages("repair"):
        mesh, repaired = repair(mesh)
    return mesh, [*dropped, *repaired]


def _coarse(field: MeshedField, data: Float, resolution: int) -> SignedDistance:
    """Return the field in single precision where that places vertices well within a cell; projection makes them exact.

    Features of high frequency with large weights cancel, so the error is measured and not assumed.
    """
    some = data[:: max(1, len(data) // 2000)]
    single = field.single()
    error = np.abs(single.sdf(some) - field.sdf(some)).max()
    cell = np.ptp(field.bounds, axis=0).max() / resolution
    return single if error < 0.2 * cell else field
