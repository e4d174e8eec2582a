"""Virtual scans of mesh files: points drawn on the whole surface, or on what a plane leaves of it, open at the cut.

Whole surfaces are sampled as trimesh's `sample_surface` samples them, number for number, so that figures which were
measured elsewhere on the scan of a seed are figures of the scan that is drawn here.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.accuracy.problem import Problem
from benchmarks.accuracy.scans import ShapeFile, load_shape, unit
from gnrecon.export.boolean import centre_and_size, from_solid, manifold_error, to_solid
from gnrecon.export.mesh_statistics import submesh
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import Frame, PointCloud
from gnrecon.runtime.errors import InputError


@dataclass(frozen=True)
class Sampling:
    """How points are drawn on a surface of radius one; lengths are in radii.

    Parameters
    ----------
    points : number, uniform by area
    noise : standard deviation of each coordinate
    tilt : angle in degrees; to each unit normal a Gaussian vector is added, whose part across the normal has a root
        mean square length of the angle's tangent
    normals : whether the scan has any
    gaps : number of balls about random points of the surface whose points are left out
    gap_radii : of the smallest and of the largest ball; the others lie evenly between
    """

    points: int
    noise: float = 0.0
    tilt: float = 0.0
    normals: bool = True
    gaps: int = 0
    gap_radii: tuple[float, float] = (0.05, 0.11)

    def scan(self, surface: Mesh, seed: int) -> PointCloud:
        """Return the scan of a seed. Its normals lead to the side that the faces of the surface look to."""
        points, normals = draw_surface(surface, self.points, seed)
        for center, radius in zip(*self.balls(surface, seed), strict=True):
            outside = np.linalg.norm(points - center, axis=1) > radius
            points, normals = points[outside], normals[outside]
        rng = np.random.default_rng(seed)
        # Two directions lie across a normal, so that each has half of the mean square.
        deviation = np.tan(np.radians(self.tilt)) / np.sqrt(2)
        normals = unit(normals + deviation * rng.standard_normal(normals.shape))
        points = points + self.noise * rng.standard_normal(points.shape)
        return PointCloud(points, normals if self.normals else None)

    def balls(self, surface: Mesh, seed: int) -> tuple[Float, Float]:
        """Return the centres, of shape (gaps, 3), and the radii of the balls that the scan of a seed leaves out."""
        return draw_surface(surface, self.gaps, seed + 1)[0], np.linspace(*self.gap_radii, self.gaps)


def draw_surface(mesh: Mesh, count: int, seed: int) -> tuple[Float, Float]:
    """Return points on a mesh, uniform by area, and the unit normals of their faces, both of shape (N, 3).

    The draws are those of trimesh: a face for each point, then its two coordinates along the edges of the first corner;
    a point outside of the triangle is put back into it.
    """
    rng, vectors = np.random.default_rng(seed), mesh.face_vectors
    until = np.cumsum(np.linalg.norm(vectors, axis=1))
    faces = np.searchsorted(until, rng.random(count) * until[-1])
    along = rng.random((count, 2))
    along = np.where(along.sum(axis=1, keepdims=True) > 1, 1 - along, along)
    first, second, third = np.moveaxis(mesh.corners[faces], 1, 0)
    points = first + along[:, :1] * (second - first) + along[:, 1:] * (third - first)
    return points, unit(vectors[faces])


@dataclass(frozen=True)
class SurfaceScan:
    """A scan of the whole surface of a mesh file, in the frame of `load_shape`.

    Normals lead to the side that the faces of the file look to, which may be the inside.

    Parameters
    ----------
    shape : the file
    sampling : how points are drawn
    genus : of the surface; None where it is not a manifold
    """

    shape: ShapeFile
    sampling: Sampling
    genus: int | None = None

    def problem(self, data: Path, seed: int) -> Problem:
        """Return the scan of a seed and the shape, whose file lies in the folder `data`.

        Raises
        ------
        InputError
            When the file is missing or cannot be read.
        """
        truth = load_shape(self.shape, data)
        return Problem(self.sampling.scan(truth, seed), truth, self.genus, up=self.shape.up, view=self.shape.view)


@dataclass(frozen=True)
class Cut:
    """A plane across a shape of radius one about the origin.

    Parameters
    ----------
    towards : direction across the plane to the part that is kept, of any length
    distance : of the plane from the origin along that direction, in radii
    """

    towards: tuple[float, float, float]
    distance: float


@dataclass(frozen=True)
class OpenScan:
    """A scan of a part of a mesh file that ends open at a plane, such as a head without the neck.

    Points are drawn on the kept part of the surface alone. The frame is that of this part: the mean of its vertices is
    the origin, and their largest distance from it the unit of length. The faces look outward, whatever those of the
    file do. The kept part is not closed, and what closes it is invention. So the truth has the flat cap of the cut as
    its lid: a mesh may end open there or be closed, flat at no cost; see `gnrecon.export.measure`.

    Parameters
    ----------
    shape : the file, and how the part is drawn
    cut : in the frame of `load_shape`, of the whole shape
    sampling : how points are drawn
    """

    shape: ShapeFile
    cut: Cut
    sampling: Sampling

    def problem(self, data: Path, seed: int) -> Problem:
        """Return the scan of a seed, the part, and its lid; the shape's file lies in the folder `data`.

        Raises
        ------
        InputError
            When the file is missing or cannot be read, or the plane leaves nothing.
        """
        part, lid = cut_open(load_shape(self.shape, data), self.cut)
        frame = Frame.of(part.vertices)
        truth, lid = (surface.with_vertices(frame.to_unit(surface.vertices)) for surface in (part, lid))
        return Problem(self.sampling.scan(truth, seed), truth, lid=lid, up=self.shape.up, view=self.shape.view)


def cut_open(mesh: Mesh, cut: Cut, *, on_plane: float = 1e-9) -> tuple[Mesh, Mesh]:
    """Return what a plane leaves of a closed mesh, open at the cut, and the flat faces that close it.

    Where the plane leaves several pieces, the one of the largest volume is returned. Faces look outward.

    Parameters
    ----------
    mesh : of radius about one, its faces all outward or all inward
    cut : the plane
    on_plane : largest distance from the plane, in radii, of the corners of a face that closes the cut

    Raises
    ------
    InputError
        When the mesh bounds no solid, or the plane does not cut it.
    """
    outward = mesh if mesh.volume > 0 else Mesh(mesh.vertices, mesh.faces[:, ::-1])
    solid = to_solid(outward, merge=False)
    if error := manifold_error(solid):
        raise InputError(f"The shape cannot be cut, because it bounds no solid: {error}.")
    direction = np.array(cut.towards) / np.linalg.norm(cut.towards)
    centre, size = centre_and_size(outward)
    pieces = solid.trim_by_plane(direction.tolist(), float(cut.distance - direction @ centre) / size).decompose()
    if not pieces:
        raise InputError(f"The plane {cut.distance:g} from the origin leaves nothing of the shape.")
    piece = from_solid(max(pieces, key=lambda part: float(part.volume())), outward)
    near = np.abs(piece.vertices @ direction - cut.distance) <= on_plane
    flat = near[piece.faces].all(axis=1)
    if not flat.any():
        raise InputError(f"The plane {cut.distance:g} from the origin does not cut the shape.")
    return submesh(piece, ~flat), submesh(piece, flat)
