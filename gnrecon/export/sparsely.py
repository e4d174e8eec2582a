"""A costly quantity that varies smoothly over a surface, computed at some vertices and interpolated at the others.

Near means near in position and in normal, so that the two sides of a thin sheet do not mix. Interpolation is the
inverse-distance mean of the four nearest, of logarithms, because the quantity is positive and may span decades.
Source: Shepard, A two-dimensional interpolation function for irregularly-spaced data (1968).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial import cKDTree

from gnrecon.geometry.arrays import Float
from gnrecon.geometry.mesh import Mesh

MOST = 20_000
"""Vertices at which the quantity is computed."""

NEAREST = 4
TURN = 4.0
"""Normals a radian apart are as far from each other as so many spacings of the chosen vertices."""


def sparsely(quantity: Callable[[Float], Float], mesh: Mesh, most: int = MOST, seed: int = 0) -> Float:
    """Return a positive quantity at all vertices of a mesh, of shape (V,).

    Parameters
    ----------
    quantity : function of points, of shape (N, 3), to positive values, of shape (N,)
    mesh : Mesh
    most : int
        Vertices at which it is called; all where the mesh has no more.
    seed : int
        Of their choice.
    """
    if len(mesh.vertices) <= most:
        return quantity(mesh.vertices)
    chosen = np.sort(np.random.default_rng(seed).permutation(len(mesh.vertices))[:most])
    known = np.log(np.maximum(quantity(mesh.vertices[chosen]), np.finfo(np.float64).tiny))
    centred = mesh.vertices - mesh.vertices.mean(axis=0)
    spacing = np.median(cKDTree(centred[chosen]).query(centred[chosen], 2)[0][:, 1])
    places = np.concatenate([centred, TURN * spacing * mesh.vertex_normals()], axis=1)
    distances, near = cKDTree(places[chosen]).query(places, NEAREST)
    weights = 1 / np.maximum(distances, 1e-6 * max(spacing, np.finfo(np.float64).tiny)) ** 2
    values: Float = np.exp((weights * known[near]).sum(axis=1) / weights.sum(axis=1))
    return values
