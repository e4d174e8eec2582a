"""What every method is given: a scan and the surface that its mesh should be; and the files (.npz) that hold them.

The files are how a benchmark and its trials exchange arrays: float64, without loss.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from gnrecon.geometry.arrays import Float
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import PointCloud


@dataclass(frozen=True)
class Problem:
    """A scan and its truth, in one frame.

    Parameters
    ----------
    scan : PointCloud
    truth : Mesh or PointCloud
        What meshes are measured against; points where no surface is known.
    genus : int, optional
        The truth's, where it is known.
    radius : float, optional
        Distances are reported in 1e-3 of it; None where they are reported in the scan's own unit.
    outliers : bool
        Whether the scan is known to hold points far off the surface, so that every method may remove them.
    surface_samples : int
        Samples on each surface for distances between samples, as published for the SRB; 0 for none.
    lid : Mesh, optional
        Faces that close the openings of the truth: a mesh may lie on them, but need not; see `gnrecon.export.measure`.
    up, view : str, (azimuth, elevation) in degrees
        View of pictures.
    """

    scan: PointCloud
    truth: Mesh | PointCloud
    genus: int | None = None
    radius: float | None = 1.0
    outliers: bool = False
    surface_samples: int = 0
    lid: Mesh | None = None
    up: str = "z"
    view: tuple[float, float] = (35.0, 25.0)

    @property
    def factor(self) -> float:
        """What distances are multiplied by to be reported."""
        return 1.0 if self.radius is None else 1e3 / self.radius

    @property
    def unit(self) -> str:
        """Unit of the reported distances."""
        return "the scan's unit" if self.radius is None else "1e-3 of the radius"


class Case(Protocol):
    """A line of a table of cases."""

    def problem(self, data: Path, seed: int) -> Problem:
        """Return the problem of a seed, reading what it needs from the folder `data`.

        Raises
        ------
        InputError
            When a file is missing or cannot be read.
        """
        ...


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
