"""The nearest points of a surface, found by open3d's ray-casting tree, and which points lie inside of it.

The tree works in float32. Positions are therefore centred and scaled to one first, and the foot point is computed again
in float64 from the nearest triangle and its barycentric coordinates: a rounding of 1e-7 then shifts the foot along the
triangle only, and changes the distance to second order.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from gnrecon.export.solid import centre_and_size
from gnrecon.geometry.arrays import Float, Int, Mask
from gnrecon.geometry.mesh import Mesh
from gnrecon.runtime.parallel import slices

RAYS = 5
"""Rays that vote on whether a point lies inside: one alone may graze an edge and count it twice, or not at all."""


def ray_scene(vertices: Float, faces: Int) -> Any:
    """open3d's tree over triangles, whose vertices of shape (V, 3) should be about one in size."""
    import open3d

    scene: Any = open3d.t.geometry.RaycastingScene()
    tensor = open3d.core.Tensor.from_numpy
    scene.add_triangles(tensor(vertices.astype(np.float32)), tensor(faces.astype(np.uint32)))
    return scene


class Surface:
    """A mesh with faces, ready for many queries.

    Parameters
    ----------
    mesh : Mesh
    batch : int
        Most points that the tree is asked for at once.
    """

    def __init__(self, mesh: Mesh, batch: int = 1_000_000) -> None:
        self._centre, self._size = centre_and_size(mesh)
        self._scene = ray_scene((mesh.vertices - self._centre) / self._size, mesh.faces)
        self._corners, self._batch = mesh.corners, batch

    def nearest(self, points: Float) -> tuple[Float, Int]:
        """Return the nearest points of the surface, of shape (N, 3), and their faces, for points of shape (N, 3)."""
        feet = np.empty((len(points), 3))
        faces = np.empty(len(points), dtype=np.int64)
        for rows in slices(len(points), self._batch):
            answer = self._scene.compute_closest_points(self._queries(points[rows]))
            faces[rows] = answer["primitive_ids"].numpy()
            u, v = np.moveaxis(answer["primitive_uvs"].numpy().astype(np.float64), 1, 0)
            weights = np.stack([1 - u - v, u, v], axis=1)
            feet[rows] = np.einsum("ij,ijk->ik", weights, self._corners[faces[rows]])
        return feet, faces

    def inside(self, points: Float) -> Mask:
        """Return which points, of shape (N, 3), a closed surface encloses, to about 1e-7 of its size."""
        inside = np.empty(len(points), dtype=bool)
        for rows in slices(len(points), self._batch):
            answer = self._scene.compute_occupancy(self._queries(points[rows]), nsamples=RAYS)
            inside[rows] = answer.numpy() > 0
        return inside

    def _queries(self, points: Float) -> Any:
        from open3d import core

        return core.Tensor.from_numpy(((points - self._centre) / self._size).astype(np.float32))


def nearest_on_surface(mesh: Mesh, points: Float, batch: int = 1_000_000) -> tuple[Float, Int]:
    """Distance to a surface, in its units, and the nearest face, for points of shape (N, 3)."""
    feet, faces = Surface(mesh, batch).nearest(points)
    return np.linalg.norm(points - feet, axis=1), faces
