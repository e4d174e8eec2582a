"""Scans of known surfaces: analytic shapes with stated faults, published scans, and vertices of the paper's shapes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.accuracy.analytic_solids import SOLIDS, Solid
from benchmarks.accuracy.problem import Problem
from benchmarks.harness.command_line import REPOSITORY
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import Frame, PointCloud
from gnrecon.io import read_cloud, read_mesh
from gnrecon.runtime.errors import InputError


@dataclass(frozen=True)
class AnalyticScan:
    """A scan of one of the analytic shapes, whose radius is one; lengths are in radii.

    Parameters
    ----------
    shape : name in `analytic_solids.SOLIDS`
    points : number, uniform by area unless `uneven` or `hole` says otherwise
    noise : standard deviation of each coordinate
    tilt : angle in degrees by which each normal is turned, in a direction of its own
    uneven : how many times denser the points are at x = 1 than at x = -1, exponential between them
    hole : radius of a ball about a random place of the surface in which there are no points
    outliers : share of the points that are replaced by points anywhere in a box, with normals in any direction
    normals : whether the scan has any
    outlier_box : half the side of the box in which outliers are scattered
    """

    shape: str
    points: int
    noise: float = 0.0
    tilt: float = 0.0
    uneven: float = 1.0
    hole: float = 0.0
    outliers: float = 0.0
    normals: bool = True
    outlier_box: float = 1.1

    def problem(self, data: Path, seed: int) -> Problem:  # noqa: ARG002 - other cases read files
        """Return the scan of a seed, and the exact shape."""
        solid, rng = SOLIDS[self.shape], np.random.default_rng(seed)
        points, normals = self._places(solid, rng)
        points = points + self.noise * rng.standard_normal(points.shape)
        normals = tilted(normals, self.tilt, rng)
        if self.outliers:
            rows = rng.choice(self.points, round(self.outliers * self.points), replace=False)
            points[rows] = rng.uniform(-self.outlier_box, self.outlier_box, (len(rows), 3))
            normals[rows] = unit(rng.standard_normal((len(rows), 3)))
        scan = PointCloud(points, normals if self.normals else None)
        return Problem(scan, solid.mesh(), solid.genus, outliers=self.outliers > 0)

    def _places(self, solid: Solid, rng: np.random.Generator) -> tuple[Float, Float]:
        """Return points on the surface outside of the hole, with the wanted density, and their normals."""
        middle = solid.draw(1, rng)[0]
        kept = np.empty((0, 6))
        while len(kept) < self.points:
            points, normals = solid.draw(self.points, rng)
            # Where x is 1 each is kept, elsewhere as many as the density asks for.
            wanted = rng.random(len(points)) < self.uneven ** ((points[:, 0] - 1) / 2)
            wanted &= np.linalg.norm(points - middle, axis=1) >= self.hole
            kept = np.concatenate([kept, np.hstack([points, normals])[wanted]])
        return kept[: self.points, :3], kept[: self.points, 3:]


def tilted(normals: Float, degrees: float, rng: np.random.Generator) -> Float:
    """Return unit normals, of shape (N, 3), each turned by the angle about a random axis across it."""
    across = np.cross(normals, unit(rng.standard_normal(normals.shape)))
    angle = np.radians(degrees)
    return np.asarray(np.cos(angle) * normals + np.sin(angle) * unit(across))


def unit(vectors: Float) -> Float:
    """Return vectors, of shape (N, 3), at length one."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


@dataclass(frozen=True)
class RangeScan:
    """A simulated range scan, compared in its own unit; by the distances of the DiGS protocol as well.

    Parameters
    ----------
    file : within the data folder
    truth : file of the true surface; where there is none, meshes are measured against the scan itself
    genus : of the true surface
    normals : whether those of the file are given to the methods
    up, view : how it is drawn: the upward axis, azimuth and elevation in degrees
    samples : on each surface for the distances of the DiGS protocol (Ben-Shabat et al. 2022)
    """

    file: str
    truth: str | None = None
    genus: int | None = None
    normals: bool = True
    up: str = "y"
    view: tuple[float, float] = (25.0, 15.0)
    samples: int = 1_000_000

    def problem(self, data: Path, seed: int) -> Problem:  # noqa: ARG002 - the scan is as it is
        """Return the scan, and its truth or itself.

        Raises
        ------
        InputError
            When a file is missing or cannot be read.
        """
        scan = read_cloud(_required(data / self.file))
        truth: Mesh | PointCloud = scan if self.truth is None else read_mesh(_required(data / self.truth))
        given = scan if self.normals else scan.with_normals(None)
        samples = self.samples if self.truth else 0
        return Problem(given, truth, self.genus, None, surface_samples=samples, up=self.up, view=self.view)


@dataclass(frozen=True)
class UnorientedScan:
    """Points without normals, and the file of the true surface, both in the unit frame of that surface."""

    file: str
    truth: str
    genus: int
    up: str = "y"
    view: tuple[float, float] = (25.0, 15.0)

    def problem(self, data: Path, seed: int) -> Problem:  # noqa: ARG002 - the scan is as it is
        """Return the scan and its truth.

        Raises
        ------
        InputError
            When a file is missing or cannot be read.
        """
        truth = read_mesh(_required(data / self.truth))
        frame = Frame.of(truth.vertices)
        scan = PointCloud(frame.to_unit(read_cloud(_required(data / self.file)).points))
        return Problem(scan, Mesh(frame.to_unit(truth.vertices), truth.faces), self.genus, up=self.up, view=self.view)


@dataclass(frozen=True)
class SampleScan:
    """A scan of the repository's folder sample_data, compared in millimetres.

    Parameters
    ----------
    file, truth : of the scan and of the true surface
    genus : of the true surface
    outliers : whether the scan holds points far off the surface
    """

    file: str
    truth: str
    genus: int
    outliers: bool = False

    def problem(self, data: Path, seed: int) -> Problem:  # noqa: ARG002 - the repository has it, and it is as it is
        """Return the scan and its truth.

        Raises
        ------
        InputError
            When a file cannot be read.
        """
        folder = REPOSITORY / "sample_data"
        scan, truth = read_cloud(folder / self.file), read_mesh(folder / self.truth)
        return Problem(scan, truth, self.genus, None, outliers=self.outliers, view=(-55.0, 28.0))


def _required(path: Path) -> Path:
    if not path.is_file():
        raise InputError(f"There is no file {path}; name the folder of the data with --data.")
    return path


@dataclass(frozen=True)
class ShapeFile:
    """A mesh file of the data folder, and how it is drawn: the upward axis, azimuth and elevation in degrees."""

    file: str
    up: str
    view: tuple[float, float]


@dataclass(frozen=True)
class VertexScan:
    """A scan of a random share of a mesh's vertices, with their area-weighted normals.

    The frame is the paper's: the mean of all vertices is the origin, and their largest distance from it the unit of
    length. Vertices that no face uses have no normal: they count for the frame and for the number of points, but are
    never chosen. The genus is None where the mesh is not closed.
    """

    shape: ShapeFile
    fraction: float
    genus: int | None = None

    def problem(self, data: Path, seed: int) -> Problem:
        """Return the scan of a seed and the shape, whose file lies in the folder `data`.

        Raises
        ------
        InputError
            When the file is missing or cannot be read.
        """
        truth = load_shape(self.shape, data)
        scan = PointCloud(*draw_vertices(truth, self.fraction, seed))
        return Problem(scan, truth, self.genus, up=self.shape.up, view=self.shape.view)


ROCKER_ARM = ShapeFile("rocker-arm.off", up="z", view=(70.0, 20.0))
BUNNY = ShapeFile("bun_zipper.ply", up="y", view=(0.0, 10.0))

PAPER_SCANS = {
    "rockerarm-5": VertexScan(ROCKER_ARM, 0.05, genus=1),
    "rockerarm-20": VertexScan(ROCKER_ARM, 0.2, genus=1),
    "rockerarm-30": VertexScan(ROCKER_ARM, 0.3, genus=1),
    "rockerarm-100": VertexScan(ROCKER_ARM, 1.0, genus=1),
    "bunny-5": VertexScan(BUNNY, 0.05),
    "bunny-20": VertexScan(BUNNY, 0.2),
    "bunny-30": VertexScan(BUNNY, 0.3),
    "bunny-100": VertexScan(BUNNY, 1.0),
}


def load_shape(shape: ShapeFile, folder: Path) -> Mesh:
    """Return a shape in its unit frame.

    Raises
    ------
    InputError
        When its file is missing or cannot be read.
    """
    mesh = read_mesh(_required(folder / shape.file))
    return Mesh(Frame.of(mesh.vertices).to_unit(mesh.vertices), mesh.faces)


def draw_vertices(truth: Mesh, fraction: float, seed: int) -> tuple[Float, Float]:
    """Return points and unit normals, both of shape (N, 3).

    N is round(fraction * V) of the mesh's V vertices, or the number of those with a normal where these are fewer.
    """
    normals = truth.vertex_normals()
    candidates = np.flatnonzero(np.linalg.norm(normals, axis=1) > 0.5)
    count = min(round(fraction * len(truth.vertices)), len(candidates))
    rows = np.sort(np.random.default_rng(seed).choice(candidates, count, replace=False))
    return truth.vertices[rows], normals[rows]
