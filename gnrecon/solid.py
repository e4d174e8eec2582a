"""Meshes a fitted field as an offset, hollow or cropped solid.

In this order: mesh the field near the crop, at the resolution of the crop; extract offset surfaces from that mesh;
subtract the inner one for a shell; and cut out the box of the crop last, so that a cropped shell shows its wall.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gnrecon.export.boolean import crop, subtract
from gnrecon.export.mesh_field import MeshOptions, StageTimer, mesh_field, untimed
from gnrecon.export.metrics import nearest_on_surface
from gnrecon.export.offset import OffsetField
from gnrecon.fit import NeuralSDF
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.mesh import Mesh
from gnrecon.options import Options
from gnrecon.report.estimate import mesh_memory_mb
from gnrecon.runtime.errors import MeshError, UsageError
from gnrecon.runtime.memory_budget import require_memory
from gnrecon.runtime.progress import ProgressCallback, ignore_progress


@dataclass(frozen=True)
class Shape:
    """Offset, wall thickness and crop of a solid; lengths in file units.

    Parameters
    ----------
    offset : float
        Distance by which the surface moves outward, or inward if negative.
    shell : float, optional
        Thickness of the wall that remains, measured inward from the surface after the offset.
    crop : array of shape (2, 3), optional
        Lower and upper corner of the box that is kept.

    Raises
    ------
    UsageError
        When the thickness is not positive.
    """

    offset: float = 0.0
    shell: float | None = None
    crop: Float | None = None

    def __post_init__(self) -> None:
        if self.shell is not None and not self.shell > 0:
            raise UsageError(f"The thickness of a shell must be positive, not {self.shell:g}.")

    @property
    def levels(self) -> tuple[float, ...]:
        """Distances of the surfaces from the zero level: the outer one, and the inner one of a shell."""
        return (self.offset,) if self.shell is None else (self.offset, self.offset - self.shell)


def shaped(
    sdf: NeuralSDF,
    options: Options,
    shape: Shape,
    *,
    stages: StageTimer = untimed,
    advance: ProgressCallback = ignore_progress,
) -> tuple[Mesh, list[str]]:
    """Mesh a field in the given shape.

    Parameters
    ----------
    sdf : NeuralSDF
    options : Options
        The resolution is that of the crop where there is one, else of the field's box.
    shape : Shape
    stages, advance : callables
        Of `gnrecon.export.mesh_field.mesh_field`; the further stages are ``offset`` and ``cut``.

    Returns
    -------
    Mesh
        Closed, with normals, in file units.
    list of str
        Sentences for the user: what was dropped, repaired, or is not supported by data.

    Raises
    ------
    UsageError
        When the crop misses the field's box, the shape leaves nothing of the solid, or a length is out of reach.
    MemoryLimitError
        When the cells are too many for the memory that is left.
    MeshError
        When there is no zero level, or no sound mesh can be made of it.
    """
    _require_in_proportion(shape, sdf.bounds)
    box = sdf.bounds if shape.crop is None else shape.crop
    cell = float(np.ptp(box, axis=0).max()) / options.mesh().cells(box)
    region = sdf.bounds
    if shape.crop is not None:
        # Whatever closes the surface at the region's border is farther from the crop than any level reaches.
        region = _around(shape.crop, max(map(abs, shape.levels)) + _margin(cell), sdf.bounds)
    replace(options, edge_length=None).require_reachable(region)  # the cells above have been checked
    for level in (0.0, *shape.levels):
        around = region + max(level, 0.0) * np.array([[-1.0], [1.0]])
        require_memory(mesh_memory_mb(float(np.ptp(around, axis=0).max()) / cell, around))
    data, remarks = _data(sdf, region)
    # A mesh that only serves to measure offsets from is not refined.
    plain = options if 0.0 in shape.levels else replace(options, remesh=None, adaptive=False, simplify=None, faces=None)
    meshed = mesh_field(sdf, _at(plain, region, cell), data=data, bounds=region, stages=stages, advance=advance)
    mesh, remarks = meshed.mesh, remarks + meshed.actions
    if options.edge_length is not None and options.max_error is None:
        remarks.append(meshed.fineness.describe())  # meshing got a resolution, and so does not report it
    surfaces = []
    for level in shape.levels:
        surface = mesh
        if level != 0:
            with stages("offset"):
                surface, actions = _offset(mesh, level, sdf, options, cell, shape.crop, advance)
            remarks += actions
        surfaces.append(surface)
    if len(surfaces) == 1 and shape.crop is None:
        return surfaces[0], remarks
    with stages("cut"):
        result = surfaces[0] if len(surfaces) == 1 else subtract(*surfaces)
        return result if shape.crop is None else crop(result, shape.crop), remarks


def _require_in_proportion(shape: Shape, limits: Float, *, most_sizes: float = 10.0, least_size: float = 1e-6) -> None:
    """Refuse lengths that have nothing to do with the model, before the work.

    Parameters
    ----------
    shape : whose lengths are checked
    limits : box of the model, of shape (2, 3)
    most_sizes : of the box's longest side, for offsets: the model is a point within a ball then, and meshing that takes
        minutes
    least_size : of the same, for the sides of a crop: the field is stored with single precision
    """
    size = float(np.ptp(limits, axis=0).max())
    for level in shape.levels:
        if abs(level) > most_sizes * size:
            raise UsageError(
                f"A distance of {level:g} is out of proportion to the model, whose longest side is {size:.3g}."
            )
    if shape.crop is not None and np.ptp(shape.crop, axis=0).min() < least_size * size:
        raise UsageError(
            f"The crop is thinner than a millionth of the model; the box of the model is {_corners(limits)}."
        )


def _margin(cell: float, *, cells: float = 3) -> float:
    """How far beyond a crop is meshed, so that what closes the surface at the border is cut away."""
    return cells * cell


def _around(box: Float, reach: float, limits: Float) -> Float:
    """A box grown by `reach` on each side, within `limits`; all boxes of shape (2, 3)."""
    low, high = np.maximum(box[0] - reach, limits[0]), np.minimum(box[1] + reach, limits[1])
    if not (low < high).all():
        raise UsageError(f"The crop lies outside of the model; the box of the model is {_corners(limits)}.")
    return np.stack([low, high])


def _corners(box: Float) -> str:
    return ",".join(f"{number:.9g}" for number in box.ravel())


def _at(options: Options, region: Float, cell: float) -> MeshOptions:
    """The options of the meshing for another box, with cells of the given size."""
    cells = max(16, int(np.ceil(np.ptp(region, axis=0).max() / cell - 1e-9)))
    return replace(options, resolution=cells, edge_length=None).mesh()


def _data(sdf: NeuralSDF, region: Float) -> tuple[Float | None, list[str]]:
    """The points that support parts of the mesh, and a sentence where there are none."""
    if sdf.data is None:
        return None, ["The model holds no points of its scan, so parts that no data supports are kept."]
    near = sdf.data[((sdf.data >= region[0]) & (sdf.data <= region[1])).all(axis=1)]
    if not len(near):
        return None, ["None of the model's points lie in the box: the mesh there is not supported by data."]
    return near, []


def _offset(
    mesh: Mesh,
    level: float,
    sdf: NeuralSDF,
    options: Options,
    cell: float,
    box: Float | None,
    advance: ProgressCallback,
) -> tuple[Mesh, list[str]]:
    """The surface at a distance from a mesh, and a sentence with the measured distance of its vertices."""
    reach = max(level, 0.0) + _margin(cell)
    bounds = np.stack([mesh.vertices.min(axis=0) - reach, mesh.vertices.max(axis=0) + reach])
    if box is not None:
        bounds = _around(box, _margin(cell), bounds)
    field = OffsetField(mesh, level, sdf.frame, bounds)
    try:
        meshed = mesh_field(field, _at(options, bounds, cell), data=None, bounds=bounds, advance=advance)
    except MeshError:
        _require_depth(field, bounds)
        raise
    surface, remarks = meshed.mesh, meshed.actions
    inner = ((surface.vertices > bounds[0] + 2 * cell) & (surface.vertices < bounds[1] - 2 * cell)).all(axis=1)
    lengths = nearest_on_surface(mesh, surface.vertices[inner])[0]
    if not len(lengths):
        return surface, remarks
    found = f"{lengths.mean():.6g} units from the zero level on average, {lengths.min():.6g} to {lengths.max():.6g}"
    return surface, [*remarks, f"The surface offset by {level:g} lies {found}."]


def _require_depth(field: OffsetField, bounds: Float, *, probes_per_side: int = 48) -> None:
    """Raise a UsageError if a surface is missing because the solid is not deep enough.

    `probes_per_side` points along each side of the box look for the deepest place: a wall of 1/48 of the box is found.
    """
    axes = [np.linspace(low, high, probes_per_side) for low, high in bounds.T]
    values = field.sdf(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3))
    if values.min() >= 0:
        deepest = max(0.0, -(float(values.min()) + field.level))
        raise UsageError(
            f"An offset of {field.level:g} leaves nothing: the solid is nowhere deeper than about {deepest:.3g} units."
        )
