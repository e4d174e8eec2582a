"""Converts clouds and meshes from and to trimesh, open3d, pymeshlab, pyvista and meshio, and from arrays and tables.

An object's type is recognised by the module that defines it, so that no library is imported that the caller has not
loaded. Nothing is processed: vertices and faces stay the same, in the same order. Of the many kinds of cells that
pyvista and meshio have, triangles and polygons are surfaces; volumes give their outer surface, and grids whose points
are implied by a spacing are refused, because they hold values in a volume and not a scan.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from gnrecon.geometry.arrays import Float, Int, Values
from gnrecon.geometry.colors import as_bytes
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.io.contents import fan_triangles, from_columns, no_faces
from gnrecon.runtime.errors import InputError, UsageError
from gnrecon.runtime.quiet_imports import import_open3d, import_uninterrupted


def as_cloud(obj: Any, normals: npt.ArrayLike | None = None) -> PointCloud:
    """Return a cloud from any common representation of points.

    Parameters
    ----------
    obj : array of shape (N, 3), or (N, 6) with normals; torch tensor of the same; structured array, mapping or data
        frame of columns x, y, z, nx, ny, nz, red, ... as in files; open3d PointCloud (legacy or tensor); trimesh
        PointCloud; pymeshlab Mesh or MeshSet (its current mesh); pyvista PolyData or DataSet; meshio Mesh; PointCloud;
        Mesh and other libraries' meshes, of which the vertices are taken; path of a file, which is read
    normals : array of shape (N, 3), optional
        Used instead of those of `obj`.

    Raises
    ------
    InputError
        When `obj` is none of these, a file cannot be read, or shapes do not fit.
    """
    found = _from_file(obj, "read_cloud") if isinstance(obj, str | Path) else as_shape(obj)
    if isinstance(found, Mesh):
        found = PointCloud(found.vertices, found.vertex_normals(), found.attributes)
    return found if normals is None else found.with_normals(_array(normals))


def as_mesh(obj: Any) -> Mesh:
    """Return a mesh from any common representation of meshes.

    Parameters
    ----------
    obj : open3d TriangleMesh (legacy or tensor); trimesh Trimesh; pymeshlab Mesh or MeshSet (its current mesh); pyvista
        PolyData or DataSet; meshio Mesh; a pair of vertices, of shape (V, 3), and faces, of shape (F, 3), as arrays or
        tensors; Mesh; path of a file, which is read

    Raises
    ------
    InputError
        When `obj` is none of these, has no faces, or shapes do not fit.
    """
    pair = "a pair of vertices, of shape (V, 3), and faces, of shape (F, 3)"
    expected = f"a mesh of open3d, trimesh, pymeshlab, pyvista or meshio, its file, or {pair}"
    found = _from_file(obj, "read_mesh") if isinstance(obj, str | Path) else _from_library(obj)
    if found is None and isinstance(obj, tuple | list) and len(obj) == 2:
        vertices, faces = (_array(part, expected) for part in obj)
        if vertices.ndim == faces.ndim == 2 and vertices.shape[1] == faces.shape[1] == 3:
            found = Mesh(vertices, faces.astype(np.int64))
    if not isinstance(found, Mesh) or not len(found.faces):
        raise InputError(f"Expected {expected}, but got {type(obj).__name__}{' without faces' if found else ''}.")
    return found


def as_shape(obj: Any) -> Mesh | PointCloud:
    """Return a mesh where an object has faces, else a cloud; paths are not read, as plugins' results come here."""
    if (found := _from_library(obj)) is not None:
        return found
    if names := _names(obj):
        return from_columns({name: _column(obj[name]) for name in names}).shape()
    return _from_array(_array(obj))


def _from_file(path: str | Path, kind: str) -> Any:
    """What a function of `gnrecon.io.read` reads from a file."""
    # Imported here, because its table of formats takes what plugins return through this module.
    from gnrecon.io import read

    return getattr(read, kind)(Path(path))


def _from_library(obj: Any) -> Mesh | PointCloud | None:
    """The mesh or cloud of an object of a known library; None for other objects."""
    if isinstance(obj, PointCloud | Mesh):
        return obj
    # All base classes count, so that subclasses of a library's types are recognised.
    libraries = {kind.__module__.partition(".")[0] for kind in type(obj).__mro__}
    if "open3d" in libraries and any(hasattr(obj, name) for name in ("point", "vertex", "points", "triangles")):
        return _from_open3d(obj)
    if "trimesh" in libraries and hasattr(obj, "vertices"):
        return _from_trimesh(obj)
    if "pymeshlab" in libraries and (hasattr(obj, "current_mesh") or hasattr(obj, "vertex_matrix")):
        return _from_pymeshlab(obj)
    if "pyvista" in libraries and hasattr(obj, "bounds"):
        return _from_pyvista(obj)
    if "meshio" in libraries and hasattr(obj, "cells"):
        return _from_meshio(obj)
    return None


def _mesh_or_cloud(points: Any, faces: Any, attributes: Mapping[str, Any]) -> Mesh | PointCloud:
    """A mesh where there are faces, else a cloud, with the attributes as `from_columns` sorts them.

    Attributes that are no number or row of numbers at each point are left out.
    """
    held = {name: np.array(values) for name, values in attributes.items()}
    held = {name: values for name, values in held.items() if values.dtype.kind in "biuf" and values.ndim <= 2}
    normals = held.pop("normals", None)
    indices = no_faces() if faces is None else np.asarray(faces, np.int64)
    found = from_columns(held, indices, np.array(points))
    return (found if normals is None else replace(found, normals=normals)).shape()


def _from_open3d(obj: Any) -> Mesh | PointCloud:
    """A tensor geometry; legacy ones are converted to one, in double precision."""
    if not (hasattr(obj, "point") or hasattr(obj, "vertex")):
        geometry = import_open3d().t.geometry
        kind = geometry.PointCloud if hasattr(obj, "points") else geometry.TriangleMesh
        obj = kind.from_legacy(obj, import_open3d().core.float64)
    carrier = obj.point if hasattr(obj, "point") else obj.vertex
    arrays = {name: carrier[name].cpu().numpy() for name in carrier}
    if "positions" not in arrays:
        raise InputError("The open3d point cloud or mesh holds no positions.")
    faces = obj.triangle.indices.cpu().numpy() if hasattr(obj, "triangle") and "indices" in obj.triangle else None
    return _mesh_or_cloud(arrays.pop("positions"), faces, arrays)


def _from_trimesh(obj: Any) -> Mesh | PointCloud:
    colors = obj.visual.vertex_colors if obj.visual.kind == "vertex" else ()
    faces = getattr(obj, "faces", no_faces())
    normals = obj.vertex_normals if len(faces) else _trimesh_normals(obj)
    held = dict(obj.vertex_attributes) if len(faces) else {}
    # trimesh may report vertex colours for a cloud that has none.
    held |= ({"colors": colors} if len(colors) else {}) | ({} if normals is None else {"normals": normals})
    return _mesh_or_cloud(obj.vertices, faces, held)


def _trimesh_normals(cloud: Any) -> Float | None:
    """The normals of a trimesh cloud, which has no place of its own for them.

    They are an attribute that the caller set, or metadata, or columns of the PLY file that trimesh read it from.
    """
    places = (vars(cloud), cloud.metadata)
    found = next((place[name] for name in ("vertex_normals", "normals") for place in places if name in place), None)
    if found is None:
        columns = cloud.metadata.get("_ply_raw", {}).get("vertex", {}).get("data", {})
        names = columns.dtype.names or () if isinstance(columns, np.ndarray) else columns
        if {"nx", "ny", "nz"} <= set(names):
            found = np.stack([np.asarray(columns[name], np.float64).reshape(-1) for name in ("nx", "ny", "nz")], axis=1)
    # After the caller removed points, columns of the file no longer fit.
    return None if found is None or np.shape(found) != np.shape(cloud.vertices) else np.array(found, np.float64)


def _from_pymeshlab(obj: Any) -> Mesh | PointCloud:
    if hasattr(obj, "current_mesh"):
        if not obj.mesh_number():
            raise InputError("The pymeshlab MeshSet holds no mesh.")
        obj = obj.current_mesh()
    points, faces, normals = obj.transformed_vertex_matrix(), obj.face_matrix(), obj.vertex_normal_matrix()
    colors, values = obj.vertex_color_matrix(), obj.vertex_scalar_array()
    # Every pymeshlab mesh has normals (computed from its faces), colours (white by default) and values (0 by default).
    held = {} if (colors == 1).all() else {"colors": np.rint(255 * colors).astype(np.uint8)}
    held |= {"quality": values} if values.any() else {}
    linear = obj.transform_matrix()[:3, :3]
    held |= {"normals": np.linalg.solve(linear.T, normals.T).T} if normals.any() and not len(faces) else {}
    return _mesh_or_cloud(points, faces, held)


def _from_pyvista(obj: Any) -> Mesh | PointCloud:
    """PolyData, a PointSet, or the outer surface of a structured or unstructured grid; composites are refused."""
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
    held = {name: values for name, values in obj.point_data.items() if not name.startswith("vtkOriginal")}
    if (name := obj.point_data.active_normals_name) is not None:
        held["normals"] = held.pop(name)
    return _mesh_or_cloud(obj.points, faces, held)


def _surface(grid: Any) -> Any:
    """The outer surface of a grid's cells; its points alone where it has no cells of two or three dimensions."""
    try:
        surface = grid.extract_surface(algorithm="dataset_surface")
    except TypeError:  # before pyvista 0.47 there was one algorithm
        surface = grid.extract_surface()
    return surface if len(surface.faces) else grid


def _from_meshio(obj: Any) -> Mesh | PointCloud:
    """Triangles and polygons, which are cut into fans."""
    if np.ndim(obj.points) != 2 or np.shape(obj.points)[1] != 3:
        raise InputError(f"The meshio mesh has points of shape {np.shape(obj.points)}, but (N, 3) was expected.")
    cells = [cell for block in obj.cells if block.type in ("triangle", "quad", "polygon") for cell in block.data]
    counts = np.array([len(cell) for cell in cells], np.int64)
    faces = fan_triangles(counts, np.concatenate(cells).astype(np.int64)) if cells else None
    return _mesh_or_cloud(obj.points, faces, obj.point_data)


def _names(obj: Any) -> list[str]:
    """The columns of a structured array, a mapping or a data frame; none of other objects."""
    if getattr(getattr(obj, "dtype", None), "names", None):
        return list(obj.dtype.names)
    return [str(name) for name in obj.keys()] if hasattr(obj, "keys") else []  # noqa: SIM118 - a data frame's are columns


def _column(values: Any) -> npt.NDArray[Any]:
    column = np.array(values.detach().cpu() if hasattr(values, "detach") else values)
    if column.ndim != 1 or column.dtype.kind not in "biuf":
        raise InputError(f"Expected columns of numbers, each of shape (N,), but got {column.dtype} of {column.shape}.")
    return column


def _array(obj: Any, expected: str = "") -> Float:
    """An array of float64; `expected` is what the message on anything else asks for, by default points."""
    points = "points as an array of shape (N, 3) or (N, 6), named columns with x, y and z, a file's path"
    expected = expected or f"{points}, or a cloud of open3d, trimesh, pymeshlab, pyvista or meshio"
    try:
        plain = obj.detach().cpu().numpy() if hasattr(obj, "detach") else obj  # a torch tensor, on any device
        plain = np.ma.filled(plain.astype(float), np.nan) if isinstance(plain, np.ma.MaskedArray) else plain
        if np.asarray(plain).dtype.kind != "c":
            return np.array(plain, dtype=np.float64)
        kind = "complex numbers"
    except MemoryError:
        raise
    except Exception:  # what an object raises that cannot become an array is its own choice
        kind = type(obj).__name__
    raise InputError(f"Expected {expected}, but got {kind}.")


def _from_array(rows: Float) -> PointCloud:
    if rows.ndim != 2 or rows.shape[1] not in (3, 6):
        raise InputError(f"Expected points of shape (N, 3) or (N, 6), but got {rows.shape}.")
    return PointCloud(rows[:, :3], rows[:, 3:] if rows.shape[1] == 6 else None)


def _parts(shape: Mesh | PointCloud) -> tuple[Float, Int, Float | None]:
    """Points, faces, and normals, which a mesh always has."""
    if isinstance(shape, PointCloud):
        return shape.points, no_faces(), shape.normals
    return shape.vertices, shape.faces, shape.vertex_normals()


def to_trimesh(shape: Mesh | PointCloud) -> Any:
    """Return a ``trimesh.Trimesh`` with normals and attributes, or of a cloud a ``trimesh.PointCloud`` with colours.

    The normals of a cloud are its metadata ``vertex_normals``.
    """
    trimesh = import_uninterrupted("trimesh")
    if isinstance(shape, PointCloud):
        metadata = None if shape.normals is None else {"vertex_normals": shape.normals.copy()}
        return trimesh.PointCloud(shape.points.copy(), _colors(shape), metadata)
    return trimesh.Trimesh(
        shape.vertices,
        shape.faces,
        # A copy of the normals, because trimesh makes the given array read-only.
        vertex_normals=shape.vertex_normals().copy(),
        vertex_colors=shape.attributes.get("colors"),
        vertex_attributes={name: values for name, values in shape.attributes.items() if name != "colors"},
        process=False,
    )


def to_open3d(shape: Mesh | PointCloud, *, tensor: bool = False) -> Any:
    """Return open3d's ``TriangleMesh``, or of a cloud its ``PointCloud``, with normals and colours.

    Parameters
    ----------
    shape : Mesh or PointCloud
    tensor : whether to return one of ``open3d.t.geometry``, which keeps all attributes, instead of a legacy one
    """
    core, geometry = import_open3d().core, import_open3d().t.geometry
    held, colors, (points, faces, normals) = dict(shape.attributes), _colors(shape), _parts(shape)
    if not tensor:
        held = {} if colors is None else {"colors": colors[:, :3] / 255}
    if isinstance(shape, PointCloud):
        made, carrier = geometry.PointCloud(core.Tensor(points)), "point"
    else:
        made, carrier = geometry.TriangleMesh(core.Tensor(points), core.Tensor(faces)), "vertex"
    held |= {} if normals is None else {"normals": normals}
    for name, values in held.items():
        # Attributes of open3d tensors need two dimensions.
        rows = values if values.ndim > 1 else values[:, None]
        getattr(made, carrier)[name] = core.Tensor(np.ascontiguousarray(rows))
    return made if tensor else made.to_legacy()


def to_pymeshlab(shape: Mesh | PointCloud) -> Any:
    """Return a ``pymeshlab.MeshSet`` of one mesh, with colours; a cloud is a mesh without faces, and has its normals.

    MeshLab always computes the normals of a mesh from its faces. The attribute ``quality`` becomes MeshLab's vertex
    quality; others of one or three columns become custom attributes of the same name.
    """
    try:
        import pymeshlab
    except ImportError:
        raise UsageError("This needs the package pymeshlab; install it with: pip install pymeshlab") from None
    points, faces, _ = _parts(shape)
    normals = shape.normals if isinstance(shape, PointCloud) else None
    colors, values = _colors(shape), shape.attributes.get("quality")
    given: dict[str, Values] = {} if normals is None else {"v_normals_matrix": normals}
    if colors is not None:
        opaque = np.full((len(colors), 4 - colors.shape[1]), 255)
        given["v_color_matrix"] = np.concatenate([colors, opaque], axis=1) / 255
    if values is not None:
        given["v_scalar_array"] = values.astype(np.float64)
    made = pymeshlab.Mesh(points, faces.astype(np.int32), **given)
    others = {name: column for name, column in shape.attributes.items() if name not in ("colors", "quality")}
    for name, column in others.items():
        if column.dtype.kind in "biuf" and column.shape[1:] in ((), (3,)):
            add = made.add_vertex_custom_point_attribute if column.ndim > 1 else made.add_vertex_custom_scalar_attribute
            add(column.astype(np.float64), name)
    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.add_mesh(made)
    return meshes


def to_pyvista(shape: Mesh | PointCloud) -> Any:
    """Return a ``pyvista.PolyData`` with normals and attributes; colours are its point data ``RGB`` or ``RGBA``.

    It raises `ImportError` when pyvista is not installed; gnrecon itself does not need it.
    """
    import pyvista

    points, faces, normals = _parts(shape)
    cells = np.hstack([np.full((len(faces), 1), 3), faces]).ravel()
    made = pyvista.PolyData(points.copy(), *([cells] if len(faces) else []))
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

    It raises `ImportError` when meshio is not installed; gnrecon itself does not need it.
    """
    import meshio

    points, faces, normals = _parts(shape)
    cells = ("vertex", np.arange(len(points))[:, None]) if isinstance(shape, PointCloud) else ("triangle", faces)
    held = dict(shape.attributes) | ({} if normals is None else {"normals": normals})
    return meshio.Mesh(points.copy(), [cells], point_data={name: np.array(values) for name, values in held.items()})


def _colors(shape: Mesh | PointCloud) -> npt.NDArray[np.uint8] | None:
    """8-bit colours, of shape (N, 3 or 4), or None."""
    return as_bytes(shape.attributes["colors"]) if "colors" in shape.attributes else None
