"""Converts from and to pyvista's data sets and meshio's meshes, which hold cells of many kinds.

Only triangles and polygons are surfaces here. Cells of volumes give their outer surface, and grids whose points are
implied by a spacing are refused, because they hold values in a volume and not a scan.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from gnrecon.geometry.arrays import Float, Int, Values
from gnrecon.geometry.colors import as_bytes
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.io.contents import fan_triangles
from gnrecon.runtime.errors import InputError

Parts = tuple[Float, Int | None, dict[str, npt.NDArray[Any]]]
"""Points of shape (N, 3), faces of shape (F, 3), and arrays of N rows, normals and colours among them."""


def pyvista_parts(obj: Any) -> Parts:
    """Return what a data set of pyvista holds: PolyData, PointSet, or a structured or unstructured grid.

    Raises
    ------
    InputError
        When it is a composite, or a grid of values without points of its own.
    """
    kind, kinds = type(obj).__name__, {base.__name__ for base in type(obj).__mro__}
    if not hasattr(obj, "point_data"):
        raise InputError(f"A pyvista {kind} holds several data sets: pass one of them, or what combine() makes of it.")
    if kinds & {"ImageData", "UniformGrid", "RectilinearGrid"}:
        raise InputError(f"A pyvista {kind} holds values in a volume, not points on a surface: pass its contour().")
    if kinds & {"StructuredGrid", "UnstructuredGrid"}:
        obj = _surface(obj)
    faces = None
    if hasattr(obj, "faces") and (len(obj.faces) or len(getattr(obj, "strips", ()))):
        faces = np.array(obj.triangulate().faces, np.int64).reshape(-1, 4)[:, 1:]
    held = {name: np.array(values) for name, values in obj.point_data.items() if not name.startswith("vtkOriginal")}
    if (name := obj.point_data.active_normals_name) is not None:
        held["normals"] = held.pop(name)
    return np.array(obj.points, np.float64), faces, _numbers(held)


def _surface(grid: Any) -> Any:
    """The outer surface of a grid's cells; its points alone where it has no cells of two or three dimensions."""
    try:
        surface = grid.extract_surface(algorithm="dataset_surface")
    except TypeError:  # before pyvista 0.47 there was one algorithm
        surface = grid.extract_surface()
    return surface if len(surface.faces) else grid


def meshio_parts(obj: Any) -> Parts:
    """Return what a mesh of meshio holds; polygons are cut into fans.

    Raises
    ------
    InputError
        When its points are not in three dimensions.
    """
    points = np.array(obj.points, np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"The meshio mesh has points of shape {points.shape}, but (N, 3) was expected.")
    cells = [cell for block in obj.cells if block.type in ("triangle", "quad", "polygon") for cell in block.data]
    counts = np.array([len(cell) for cell in cells], np.int64)
    faces = fan_triangles(counts, np.concatenate(cells).astype(np.int64)) if cells else None
    return points, faces, _numbers({name: np.array(values) for name, values in obj.point_data.items()})


def _numbers(held: Mapping[str, Values]) -> dict[str, npt.NDArray[Any]]:
    """The arrays that have a number or a row of numbers at each point."""
    return {name: values for name, values in held.items() if values.dtype.kind in "biuf" and values.ndim <= 2}


def to_pyvista(shape: Mesh | PointCloud) -> Any:
    """Return a ``pyvista.PolyData`` with normals and attributes; colours are its point data ``RGB`` or ``RGBA``.

    Raises
    ------
    ImportError
        When pyvista is not installed; gnrecon itself does not need it.
    """
    import pyvista

    if isinstance(shape, PointCloud):
        made, normals = pyvista.PolyData(shape.points.copy()), shape.normals
    else:
        corners = np.full((len(shape.faces), 1), 3)
        made = pyvista.PolyData(shape.vertices.copy(), np.hstack([corners, shape.faces]).ravel())
        normals = shape.vertex_normals()
    for name, values in shape.attributes.items():
        if name == "colors":
            made.point_data["RGB" if values.shape[1] == 3 else "RGBA"] = as_bytes(values)
        else:
            made.point_data[name] = values
    if normals is not None:
        made.point_data.active_normals = np.array(normals)
    return made


def to_meshio(shape: Mesh | PointCloud) -> Any:
    """Return a ``meshio.Mesh`` of triangles, or of a cloud one of vertices, with normals and attributes.

    Raises
    ------
    ImportError
        When meshio is not installed; gnrecon itself does not need it.
    """
    import meshio

    points, normals = (
        (shape.points, shape.normals) if isinstance(shape, PointCloud) else (shape.vertices, shape.vertex_normals())
    )
    cells = ("vertex", np.arange(len(points))[:, None]) if isinstance(shape, PointCloud) else ("triangle", shape.faces)
    held = dict(shape.attributes) | ({} if normals is None else {"normals": normals})
    return meshio.Mesh(points.copy(), [cells], point_data={name: np.array(values) for name, values in held.items()})
