"""The paper's two shapes, and the scans that are drawn from them.

A scan is a random choice of the mesh's vertices with their area-weighted normals. The frame is the paper's: the mean of
all vertices is the origin, and their largest distance from it the unit of length. Vertices that no face uses have no
normal: they count for the frame and for the number of points, but are never chosen.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.problem import Problem
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import Frame, PointCloud
from gnrecon.io import read_mesh
from gnrecon.runtime.errors import InputError


@dataclass(frozen=True)
class Shape:
    """A mesh file of the data folder, and from where it is drawn: the upward axis, azimuth and elevation in degrees."""

    file: str
    up: str
    view: tuple[float, float]


@dataclass(frozen=True)
class Case:
    """A shape, the share of its vertices that the scan has, and the shape's genus, None where it is not closed."""

    shape: Shape
    fraction: float
    genus: int | None = None

    def problem(self, data: Path, seed: int) -> Problem:
        """Return the scan of a seed and the shape, whose file lies in the folder `data`.

        Raises
        ------
        InputError
            When the file is missing or cannot be read.
        """
        truth = load(self.shape, data)
        scan = PointCloud(*draw(truth, self.fraction, seed))
        return Problem(scan, truth, self.genus, up=self.shape.up, view=self.shape.view)


ROCKER_ARM = Shape("rocker-arm.off", up="z", view=(70.0, 20.0))
BUNNY = Shape("bun_zipper.ply", up="y", view=(0.0, 10.0))

CASES = {
    "rockerarm-5": Case(ROCKER_ARM, 0.05, genus=1),
    "rockerarm-20": Case(ROCKER_ARM, 0.2, genus=1),
    "rockerarm-30": Case(ROCKER_ARM, 0.3, genus=1),
    "rockerarm-100": Case(ROCKER_ARM, 1.0, genus=1),
    "bunny-5": Case(BUNNY, 0.05),
    "bunny-20": Case(BUNNY, 0.2),
    "bunny-30": Case(BUNNY, 0.3),
    "bunny-100": Case(BUNNY, 1.0),
}
DEFAULT_CASES = ("rockerarm-5", "rockerarm-20", "bunny-20")


def load(shape: Shape, folder: Path) -> Mesh:
    """Return a shape in its unit frame.

    Raises
    ------
    InputError
        When its file is missing or cannot be read.
    """
    path = folder / shape.file
    if not path.is_file():
        raise InputError(f"There is no file {path}; name the folder that holds {shape.file} with --data.")
    mesh = read_mesh(path)
    return Mesh(Frame.of(mesh.vertices).to_unit(mesh.vertices), mesh.faces)


def draw(truth: Mesh, fraction: float, seed: int) -> tuple[Float, Float]:
    """Return points and unit normals, both of shape (N, 3).

    N is round(fraction * V) of the mesh's V vertices, or the number of those with a normal where these are fewer.
    """
    normals = truth.vertex_normals()
    candidates = np.flatnonzero(np.linalg.norm(normals, axis=1) > 0.5)
    count = min(round(fraction * len(truth.vertices)), len(candidates))
    rows = np.sort(np.random.default_rng(seed).choice(candidates, count, replace=False))
    return truth.vertices[rows], normals[rows]
