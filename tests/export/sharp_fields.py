"""Analytic fields with edges and corners, turned so that no edge follows the lattice, with the truth about both."""

from __future__ import annotations

import numpy as np
from analytic_fields import Field, Function
from scipy.spatial.transform import Rotation

from gnrecon.export import extract, project
from gnrecon.geometry.mesh import Mesh

Float = np.ndarray
TURN = Rotation.from_rotvec([0.4, -0.7, 0.3]).as_matrix()
HALF = np.array([0.7, 0.6, 0.35])
"""Half sides of the box."""


def turned(function: Function) -> Function:
    return lambda x: function(x @ TURN)


def box() -> Function:
    return turned(lambda x: (np.abs(x) - HALF).max(axis=1))


def cylinder(radius: float = 0.6, half_height: float = 0.5) -> Function:
    return turned(lambda x: np.maximum(np.hypot(x[:, 0], x[:, 1]) - radius, np.abs(x[:, 2]) - half_height))


def lens(radius: float = 0.8, offset: float = 0.5) -> Function:
    centre = np.array([0, 0, offset])
    return turned(lambda x: np.maximum(np.linalg.norm(x - centre, axis=1), np.linalg.norm(x + centre, axis=1)) - radius)


def notched_box() -> Function:
    """A box with a smaller one cut out of a corner: concave edges, and corners of both kinds."""
    return turned(lambda x: np.maximum((np.abs(x) - 0.6).max(axis=1), -(np.abs(x - 0.6) - 0.5).max(axis=1)))


def to_box_edges(points: Float) -> Float:
    """Distances, of shape (N,), to the nearest of the twelve edges of `box`."""
    x = np.abs(points @ TURN)
    best = np.full(len(x), np.inf)
    for axis in range(3):
        off = x - HALF
        off[:, axis] = np.maximum(off[:, axis], 0)
        best = np.minimum(best, np.linalg.norm(off, axis=1))
    return best


def to_cylinder_edges(points: Float, radius: float = 0.6, half_height: float = 0.5) -> Float:
    x = points @ TURN
    return np.hypot(np.hypot(x[:, 0], x[:, 1]) - radius, np.abs(x[:, 2]) - half_height)


def to_lens_edge(points: Float, radius: float = 0.8, offset: float = 0.5) -> Float:
    x = points @ TURN
    return np.hypot(np.hypot(x[:, 0], x[:, 1]) - np.sqrt(radius**2 - offset**2), x[:, 2])


def extracted(field: Field, resolution: int = 32) -> Mesh:
    return project(extract(field, resolution=resolution), field)


def between(mesh: Mesh) -> Float:
    """Middles of the faces and of their sides, of shape (N, 3)."""
    corners = mesh.corners
    sides = 0.5 * (corners + np.roll(corners, 1, axis=1))
    return np.concatenate([corners.mean(axis=1), sides.reshape(-1, 3)])
