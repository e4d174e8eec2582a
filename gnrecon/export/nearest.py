"""The nearest points of a surface, found by open3d's ray-casting tree.

The tree works in float32. Positions are therefore centred and scaled to one first, and the foot point is computed again
in float64 from the nearest triangle and its barycentric coordinates: a rounding of 1e-7 then shifts the foot along the
triangle only, and changes the distance to second order.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from gnrecon.cloud import Float
from gnrecon.export.solid import centre_and_size
from gnrecon.mesh import Int, Mesh


def ray_scene(vertices: Float, faces: Int) -> Any:
    """open3d's tree over triangles, whose vertices of shape (V, 3) should be about one in size."""
    import open3d

    scene: Any = open3d.t.geometry.RaycastingScene()
    tensor = open3d.core.Tensor.from_numpy
    scene.add_triangles(tensor(vertices.astype(np.float32)), tensor(faces.astype(np.uint32)))
    return scene


def nearest_on_surface(mesh: Mesh, points: Float, batch: int = 1_000_000) -> tuple[Float, Int]:
    """Distance to a surface, in its units, and the nearest face, for points of shape (N, 3)."""
    from open3d import core

    centre, size = centre_and_size(mesh)
    scene = ray_scene((mesh.vertices - centre) / size, mesh.faces)
    corners = mesh.corners
    distances = np.empty(len(points))
    faces = np.empty(len(points), dtype=np.int64)
    for start in range(0, len(points), batch):
        rows = slice(start, start + batch)
        queries = ((points[rows] - centre) / size).astype(np.float32)
        answer = scene.compute_closest_points(core.Tensor.from_numpy(queries))
        faces[rows] = answer["primitive_ids"].numpy()
        u, v = np.moveaxis(answer["primitive_uvs"].numpy().astype(np.float64), 1, 0)
        weights = np.stack([1 - u - v, u, v], axis=1)
        feet = np.einsum("ij,ijk->ik", weights, corners[faces[rows]])
        distances[rows] = np.linalg.norm(points[rows] - feet, axis=1)
    return distances, faces
