"""Clouds and meshes of other libraries, in and out of ours.

An object's type is told from the module that defines it, so that no library is imported that the caller has not loaded.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from gnrecon.cloud import PointCloud
from gnrecon.colors import as_bytes
from gnrecon.errors import InputError
from gnrecon.mesh import Mesh


def as_cloud(obj: Any, normals: npt.ArrayLike | None = None) -> PointCloud:
    """Return a cloud from any of the common carriers of points.

    Parameters
    ----------
    obj : array of shape (N, 3), or (N, 6) with normals; torch tensor of the same; open3d PointCloud (legacy or tensor);
        trimesh PointCloud or Trimesh; PointCloud; Mesh
    normals : array of shape (N, 3), optional
        Used instead of those that `obj` carries.

    Raises
    ------
    InputError
        When `obj` is none of these, or shapes do not fit.
    """
    cloud = _convert(obj)
    return cloud if normals is None else cloud.with_normals(_array(normals))


def _convert(obj: Any) -> PointCloud:
    if isinstance(obj, PointCloud):
        return obj
    if isinstance(obj, Mesh):
        return PointCloud(obj.vertices, obj.vertex_normals(), obj.attributes)
    libraries = {kind.__module__.partition(".")[0] for kind in type(obj).__mro__}
    if "open3d" in libraries and hasattr(obj, "point"):
        return _from_open3d_tensor(obj)
    if "open3d" in libraries and hasattr(obj, "points"):
        colors = {"colors": np.array(obj.colors)} if obj.has_colors() else {}
        return PointCloud(np.array(obj.points), np.array(obj.normals) if obj.has_normals() else None, colors)
    if "trimesh" in libraries and hasattr(obj, "vertices"):
        has_faces = hasattr(obj, "faces") and len(obj.faces) > 0
        normals = np.array(obj.vertex_normals) if has_faces else None
        seen = np.array(obj.visual.vertex_colors) if obj.visual.kind == "vertex" else np.empty((0, 4))
        # A cloud without colours may say that it has some, and hold none.
        return PointCloud(np.array(obj.vertices), normals, {"colors": seen} if len(seen) else {})
    return _from_array(_array(obj))


def _from_open3d_tensor(obj: Any) -> PointCloud:
    arrays = {name: obj.point[name].cpu().numpy() for name in obj.point}
    if "positions" not in arrays:
        raise InputError("The open3d point cloud holds no positions.")
    points = arrays.pop("positions")
    return PointCloud(points, arrays.pop("normals", None), arrays)


def _array(obj: Any) -> npt.NDArray[np.float64]:
    if hasattr(obj, "detach"):  # a torch tensor, on whatever device
        obj = obj.detach().cpu().numpy()
    try:
        return np.array(obj, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(
            f"Expected points as an array of shape (N, 3) or (N, 6), or a cloud of open3d or trimesh, "
            f"but got {type(obj).__name__}."
        ) from None


def _from_array(rows: npt.NDArray[np.float64]) -> PointCloud:
    if rows.ndim != 2 or rows.shape[1] not in (3, 6):
        raise InputError(f"Expected points of shape (N, 3) or (N, 6), but got {rows.shape}.")
    return PointCloud(rows[:, :3], rows[:, 3:] if rows.shape[1] == 6 else None)


def to_trimesh(mesh: Mesh) -> Any:
    """Return a ``trimesh.Trimesh`` with the same vertices, faces, vertex normals and attributes, unprocessed."""
    import trimesh

    return trimesh.Trimesh(
        mesh.vertices,
        mesh.faces,
        # A copy of the normals, because trimesh makes the array that it is given read-only.
        vertex_normals=mesh.vertex_normals().copy(),
        vertex_colors=mesh.attributes.get("colors"),
        vertex_attributes={name: values for name, values in mesh.attributes.items() if name != "colors"},
        process=False,
    )


def to_open3d(mesh: Mesh) -> Any:
    """Return a legacy ``open3d.geometry.TriangleMesh`` with the same vertices, faces, vertex normals and colours."""
    import open3d

    result = open3d.geometry.TriangleMesh(
        open3d.utility.Vector3dVector(mesh.vertices), open3d.utility.Vector3iVector(mesh.faces.astype(np.int32))
    )
    result.vertex_normals = open3d.utility.Vector3dVector(mesh.vertex_normals())
    if "colors" in mesh.attributes:
        shares = as_bytes(mesh.attributes["colors"])[:, :3] / 255
        result.vertex_colors = open3d.utility.Vector3dVector(shares)
    return result
