"""Even samples of one face of a scan: a lattice on its plane or cylinder around its points, up to other faces.

Entry: `FaceSampler.samples`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from gnrecon.fit.shape_priors.primitives import Cylinder, Plane, cosine_of
from gnrecon.fit.shape_priors.prior_parameters import ResamplingParameters
from gnrecon.fit.shape_priors.snapping import PrimitiveFace
from gnrecon.geometry.arrays import Float, Int, Mask
from gnrecon.geometry.signed_distance import Density
from gnrecon.runtime.chunks import slices


@dataclass(frozen=True)
class SurfaceGrid:
    """A lattice on a plane or a cylinder, on which coordinates are numbers of cells.

    Parameters
    ----------
    surface : Plane or Cylinder
    axes : array of shape (2, 3): of a plane both directions, of a cylinder those across its axis
    size : of a cell; around a cylinder there is a whole number of them
    around : that number, or zero
    """

    surface: Plane | Cylinder
    axes: Float
    size: float
    around: int

    @classmethod
    def of(cls, surface: Plane | Cylinder, size: float) -> SurfaceGrid:
        """Return the grid of a surface with cells of about a size, at least three around a cylinder."""
        normal = surface.direction if isinstance(surface, Plane) else surface.axis
        axes = np.linalg.svd(normal[None])[2][1:]
        around = 0 if isinstance(surface, Plane) else max(round(2 * np.pi * surface.radius / size), 3)
        return cls(surface, axes, size, around)

    @property
    def area(self) -> float:
        """Area of a cell."""
        return self.size**2 if isinstance(self.surface, Plane) else self.size * self._turn * self.surface.radius

    def cells(self, points: Float) -> Float:
        """Return coordinates, of shape (K, 2), of points on the surface, of shape (K, 3)."""
        offset = points - self.surface.center
        across = offset @ self.axes.T
        if isinstance(self.surface, Plane):
            return np.asarray(across / self.size)
        turn = np.arctan2(across[:, 1], across[:, 0]) / self._turn
        return np.stack([turn, offset @ self.surface.axis / self.size], axis=1)

    @property
    def _turn(self) -> float:
        """Angle between two cells around a cylinder."""
        return 2 * np.pi / self.around

    def wrapped(self, cells: Int) -> Int:
        """Return whole cells, of shape (M, 2), each once."""
        if self.around:
            cells = np.stack([cells[:, 0] % self.around, cells[:, 1]], axis=1)
        return np.unique(cells, axis=0)

    def places(self, cells: Int) -> Float:
        """Return the surface's points, of shape (..., 3), at cells, of shape (..., 2)."""
        if isinstance(self.surface, Plane):
            return np.asarray(self.surface.center + self.size * cells @ self.axes)
        turn = self._turn * cells[..., 0]
        outward = np.stack([np.cos(turn), np.sin(turn)], axis=-1) @ self.axes
        along = self.size * cells[..., 1:] * self.surface.axis
        return np.asarray(self.surface.center + self.surface.radius * outward + along)


@dataclass(frozen=True)
class FaceSamples:
    """Samples of a face.

    Parameters
    ----------
    grid : of the face
    cells : integer array of shape (M, 2), on the grid
    x, normals : arrays of shape (M, 3)
    start : array of shape (M, 3), the nearest point of the face to each
    sure, apart : masks of shape (M,), of those near points of the face, and of those not too close to one
    """

    grid: SurfaceGrid
    cells: Int
    x: Float
    normals: Float
    start: Float
    sure: Mask
    apart: Mask

    def sides(self) -> tuple[Float, Int]:
        """Return the 4 places next to each sample, of shape (M, 4, 3), and the samples there, -1 for none, (M, 4)."""
        cells = self.cells[:, None] + np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
        places = self.grid.places(cells)
        if self.grid.around:
            cells[..., 0] %= self.grid.around
        table = {(one, other): row for row, (one, other) in enumerate(self.cells.tolist())}
        found = [table.get((one, other), -1) for one, other in cells.reshape(-1, 2).tolist()]
        return places, np.array(found, dtype=np.int64).reshape(-1, 4)


@dataclass(frozen=True)
class FaceSampler:
    """Points with unit normals, and the faces that some of them lie on, each to be covered with samples.

    Parameters
    ----------
    density : of the points
    normals : array of shape (N, 3)
    found : the faces
    sparse_points : on a face of fewer points samples extend as far as neighbours of these are apart
    parameters : of the resampling
    """

    density: Density
    normals: Float
    found: list[PrimitiveFace]
    sparse_points: int
    parameters: ResamplingParameters

    def samples(self, number: int, spacing: float) -> FaceSamples:
        """Return samples of a face, about `spacing` apart, up to where other faces are."""
        face, p = self.found[number], self.parameters
        own, tree = self.density.points[face.rows], cKDTree(self.density.points[face.rows])
        disks = self.density.disks[face.rows]
        reach = p.reach_radii * disks
        if len(own) < self.sparse_points:
            # As far as the third neighbour.
            reach = np.maximum(reach, tree.query(own, min(3 + 1, len(own)))[0][:, -1])
        assert isinstance(face.surface, Plane | Cylinder), "no others were kept"
        grid = SurfaceGrid.of(face.surface, spacing)
        cells = grid.wrapped(cells_within(grid.cells(own), np.minimum(reach / spacing, p.reach_cells)))
        x = grid.places(cells)
        away, nearest = tree.query(x)
        kept = np.flatnonzero(away < reach[nearest])
        other = np.setdiff1d(np.arange(len(self.density.points)), face.rows)
        barriers = self.density.points[other], self.normals[other], self._barrier_radii[other]
        kept = kept[~crosses_face(x[kept], own[nearest[kept]], *barriers)]
        x, away, nearest = x[kept], away[kept], nearest[kept]
        sure, apart = away < p.sure_radii * disks[nearest], away > p.point_spacings * spacing
        return FaceSamples(grid, cells[kept], x, face.surface.normal(x), own[nearest], sure, apart)

    @cached_property
    def _barrier_radii(self) -> Float:
        """Reach of the piece of its face around each point that ways cannot cross, of shape (N,)."""
        return barrier_radii(self.density, self.normals, self.parameters.barrier_radii)


def barrier_radii(
    density: Density,
    normals: Float,
    least_radii: float,
    *,
    candidates: int = 48,
    similar_degrees: float = 30.0,
    rank: int = 3,
) -> Float:
    """Return how far from each point, of shape (N,), a way that crosses its plane crosses its face.

    Parameters
    ----------
    density : of the points
    normals : array of shape (N, 3)
    least_radii : of the result, in radii of the point's disk
    candidates : nearest neighbours of a point that are examined
    similar_degrees : between the normals of a point and a neighbour on its face
    rank : of the similar neighbour that is so far: where faces are narrow, it is farther than `least_radii`
    """
    points = density.points
    away, near = density.tree.query(points, list(range(2, min(candidates, len(points)) + 1)))
    similar = np.einsum("nkd,nd->nk", normals[near], normals) > cosine_of(similar_degrees)
    ranked = np.where(similar.cumsum(axis=1) >= rank, away, np.inf).min(axis=1)
    radii: Float = np.maximum(least_radii * density.disks, np.minimum(ranked, away[:, -1]))
    return radii


def crosses_face(x: Float, start: Float, points: Float, normals: Float, radii: Float, *, neighbours: int = 24) -> Mask:
    """Return whether ways from `start` to x, both of shape (M, 3), cross the faces of points near x.

    Parameters
    ----------
    x, start : arrays of shape (M, 3)
    points, normals : arrays of shape (K, 3), of other faces
    radii : array of shape (K,), how far around each point its plane is its face
    neighbours : of x among the points that are examined
    """
    if not len(points) or not len(x):
        return np.zeros(len(x), dtype=bool)
    _, near = cKDTree(points).query(x, list(range(1, min(neighbours, len(points)) + 1)))
    there = np.einsum("mkd,mkd->mk", x[:, None] - points[near], normals[near])
    here = np.einsum("mkd,mkd->mk", start[:, None] - points[near], normals[near])
    crosses = there * here < 0
    share = np.where(crosses, here, 0.0) / np.where(crosses, here - there, 1.0)
    at = start[:, None] + share[..., None] * (x - start)[:, None]
    hit = crosses & (np.linalg.norm(at - points[near], axis=2) < radii[near])
    return np.asarray(hit.any(axis=1))


def cells_within(cells: Float, reach: Float, *, chunk_cells: int = 500_000) -> Int:
    """Return the whole cells, of shape (M, 2), within a reach, of shape (K,), of some coordinates, of shape (K, 2).

    `chunk_cells` are examined at a time, to bound the memory.
    """
    most = int(np.ceil(reach.max())) + 1
    steps = np.stack(np.meshgrid(*[np.arange(-most, most + 1)] * 2), axis=-1).reshape(-1, 2)
    found = []
    for rows in slices(len(cells), max(1, chunk_cells // len(steps))):
        there = np.rint(cells[rows])[:, None] + steps
        near = np.linalg.norm(there - cells[rows, None], axis=2) <= reach[rows, None]
        found.append(np.unique(there[near].astype(np.int64), axis=0))
    return np.unique(np.concatenate(found), axis=0)
