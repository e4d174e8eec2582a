"""Scans and surfaces in files (.npz), through which a benchmark and its trials meet: float64, exactly as they are."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gnrecon.geometry.arrays import Float
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import PointCloud


def save_mesh(mesh: Mesh, path: Path) -> None:
    """Write vertices and faces."""
    np.savez(path, vertices=mesh.vertices, faces=mesh.faces)


def load_mesh(path: Path) -> Mesh:
    """Return a mesh that `save_mesh` wrote."""
    with np.load(path) as arrays:
        return Mesh(arrays["vertices"], arrays["faces"])


def save_scan(points: Float, normals: Float | None, path: Path) -> None:
    """Write the points of a scan, and its normals if it has any, both of shape (N, 3)."""
    if normals is None:
        np.savez(path, points=points)
    else:
        np.savez(path, points=points, normals=normals)


def load_scan(path: Path) -> tuple[Float, Float | None]:
    """Return the points and normals that `save_scan` wrote."""
    with np.load(path) as arrays:
        return arrays["points"], arrays.get("normals")


def save_truth(truth: Mesh | PointCloud, path: Path) -> None:
    """Write what meshes are measured against: a surface, or the scan where no surface is known."""
    if isinstance(truth, Mesh):
        save_mesh(truth, path)
    else:
        save_scan(truth.points, truth.normals, path)


def load_truth(path: Path) -> Mesh | PointCloud:
    """Return what `save_truth` wrote."""
    with np.load(path) as arrays:
        has_faces = "faces" in arrays
    return load_mesh(path) if has_faces else PointCloud(*load_scan(path))
