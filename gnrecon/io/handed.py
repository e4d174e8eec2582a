"""Our clouds and meshes as those of other libraries, unprocessed: the same vertices and faces in the same order."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from gnrecon.geometry.colors import as_bytes
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.io.contents import no_faces

Values = npt.NDArray[Any]


def to_trimesh(shape: Mesh | PointCloud) -> Any:
    """Return a ``trimesh.Trimesh`` with normals and attributes, or of a cloud a ``trimesh.PointCloud`` with colours."""
    import trimesh

    if isinstance(shape, PointCloud):
        return trimesh.PointCloud(shape.points.copy(), _colors(shape))  # type: ignore[no-untyped-call]
    return trimesh.Trimesh(
        shape.vertices,
        shape.faces,
        # A copy of the normals, because trimesh makes the array that it is given read-only.
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
    tensor : whether it is one of ``open3d.t.geometry``, which keeps all attributes, and not a legacy one
    """
    import open3d

    if tensor:
        return _to_open3d_tensor(shape)
    vectors, colors = open3d.utility.Vector3dVector, _colors(shape)
    shares = None if colors is None else vectors(colors[:, :3] / 255)
    if isinstance(shape, PointCloud):
        cloud = open3d.geometry.PointCloud(vectors(shape.points))
        if shape.normals is not None:
            cloud.normals = vectors(shape.normals)
        if shares is not None:
            cloud.colors = shares
        return cloud
    faces = open3d.utility.Vector3iVector(shape.faces.astype(np.int32))
    mesh = open3d.geometry.TriangleMesh(vectors(shape.vertices), faces)
    mesh.vertex_normals = vectors(shape.vertex_normals())
    if shares is not None:
        mesh.vertex_colors = shares
    return mesh


def to_pymeshlab(shape: Mesh | PointCloud) -> Any:
    """Return a ``pymeshlab.MeshSet`` of one mesh, with colours; a cloud is a mesh without faces, and has its normals.

    A mesh's normals are those that MeshLab makes of its faces, whichever it is given. The attribute ``quality`` becomes
    MeshLab's own value of a vertex, and others of one or three columns custom attributes of the same name.
    """
    import pymeshlab

    points, faces = (shape.points, no_faces()) if isinstance(shape, PointCloud) else (shape.vertices, shape.faces)
    normals = shape.normals if isinstance(shape, PointCloud) else None
    colors, values = _colors(shape), shape.attributes.get("quality")
    given: dict[str, Values] = {} if normals is None else {"v_normals_matrix": normals}
    if colors is not None:
        opaque = np.full((len(colors), 4 - colors.shape[1]), 255)
        given["v_color_matrix"] = np.concatenate([colors, opaque], axis=1) / 255
    if values is not None:
        given["v_scalar_array"] = values.astype(np.float64)
    made = pymeshlab.Mesh(points, faces.astype(np.int32), **given)
    for name, column in shape.attributes.items():
        if name not in ("colors", "quality") and column.dtype.kind in "biuf":
            _add(made, name, column.astype(np.float64))
    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.add_mesh(made)
    return meshes


def _add(mesh: Any, name: str, values: Values) -> None:
    if values.ndim == 1:
        mesh.add_vertex_custom_scalar_attribute(values, name)
    elif values.shape[1] == 3:
        mesh.add_vertex_custom_point_attribute(values, name)


def _to_open3d_tensor(shape: Mesh | PointCloud) -> Any:
    import open3d

    core: Any = open3d.core
    geometry: Any = open3d.t.geometry

    def tensor(values: Values) -> Any:
        return core.Tensor(np.ascontiguousarray(values))

    if isinstance(shape, PointCloud):
        made, carrier = geometry.PointCloud(tensor(shape.points)), "point"
    else:
        made, carrier = geometry.TriangleMesh(tensor(shape.vertices), tensor(shape.faces)), "vertex"
    normals = shape.normals if isinstance(shape, PointCloud) else shape.vertex_normals()
    held = dict(shape.attributes) | ({} if normals is None else {"normals": normals})
    for name, values in held.items():
        # Each attribute there has rows and columns.
        getattr(made, carrier)[name] = tensor(values if values.ndim > 1 else values[:, None])
    return made


def _colors(shape: Mesh | PointCloud) -> Values | None:
    """8-bit colours, of shape (N, 3 or 4), where there are some."""
    return as_bytes(shape.attributes["colors"]) if "colors" in shape.attributes else None
