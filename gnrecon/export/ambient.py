"""How much of the sky each vertex of a mesh sees, for viewers that cannot cast rays themselves."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.spatial.transform import Rotation

from gnrecon.export.nearest import ray_scene
from gnrecon.export.shading import open_sky, sphere_directions
from gnrecon.export.solid import centre_and_size
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.mesh import Mesh

REACH = 0.7
"""How near something must be to cover the sky, in halves of the mesh's longest side."""

TURNS = 8
"""Sets of directions, turned against each other: were they the same for all vertices, they would show as bands."""

PASSES = 6
"""How often a vertex takes the mean of itself and its neighbours, and so mixes their directions."""


def vertex_sky(mesh: Mesh) -> Float:
    """Return the share of the sky that each vertex sees, of shape (V,), from 0 to 1, smoothed over its neighbours."""
    centre, size = centre_and_size(mesh)
    unit = (mesh.vertices - centre) / size
    scene, normals = ray_scene(unit, mesh.faces), mesh.vertex_normals()
    share = np.empty(len(unit))
    # Normal numbers make quaternions of uniformly distributed rotations.
    rotations = Rotation.from_quat(np.random.default_rng(0).normal(size=(TURNS, 4)))
    for turn, rotation in enumerate(rotations):
        part = slice(turn, None, TURNS)
        share[part] = open_sky(scene, unit[part], normals[part], REACH, rotation.apply(sphere_directions()))
    start, end = mesh.faces[:, [0, 1, 2]].reshape(-1), mesh.faces[:, [1, 2, 0]].reshape(-1)
    own = np.arange(len(share))
    rows, columns = np.concatenate([start, end, own]), np.concatenate([end, start, own])
    near = coo_array((np.ones(len(rows)), (rows, columns)), shape=2 * (len(share),)).tocsr()
    count = near.sum(axis=1)
    for _ in range(PASSES):
        share = near @ share / count
    return share
