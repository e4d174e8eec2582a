"""Samples spread over the planes and cylinders of a clean scan, up to where they meet.

Few points leave gaps at edges and, most of all, at corners, where a sum of smooth features goes where it likes. Where
points lie on planes and cylinders, these say far more than any two neighbours do. So each surface is covered by even
samples around its own points, and of these are dropped:

- those to which the way from the nearest of its points leads through another face, that is through the plane of a point
  nearby that lies on none of the same surface;
- those on both sides of which the winding number of all samples tells the same. It is one half on a closed surface, and
  nothing or one on what goes on beyond an edge;
- of those far from the points, those with nothing beside them on some side, and so on from there: they close no gap.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from gnrecon.fit.shape_priors.primitives import LEAST, Cylinder, Plane, agreed, cosine_of
from gnrecon.fit.shape_priors.snapping import OFF, Face, Search
from gnrecon.geometry.arrays import Float, Int, Mask
from gnrecon.geometry.signed_distance import Density, winding_number
from gnrecon.runtime.chunks import slices

NOISE, ANGLE = 0.005, 10.0
"""Noise with which surfaces are looked for, in radii of a point's disk, and degrees between their normals and a
point's at most."""

FEW, EQUAL, BENT, MOST_LEFT = 3, 2.0, 40.0, 2000
"""Points that a plane has at least, where it is a small one; degrees between their normals and its own at most; up to
which a normal beside it shows that it is bent; and most points among which such planes are looked for."""

ENOUGH, MOST, MOST_POINTS = 6000, 12.0, 15_000
"""How many samples there are to be, about, or as many as points; most samples for each point; and points from which on
there are none, as faces are rounded over no more than the points' spacing."""

SURE, REACH, MOST_CELLS = 2.0, 3.0, 24.0
"""How far a sample may lie from the nearest point of its surface, in radii of that one's disk, whatever is beside it,
and where it closes a gap; on a plane of few points as far as the third of them; and how far at most, in cells."""

APART = 0.6
"""How far a sample is from every point of its surface, in spacings of the samples."""

BESIDE = 1.2
"""How near a sample of another face, or a point, is to what else would be an open side, in spacings."""

OTHERS, THROUGH = 24, 3.2
"""Points of other faces that are asked, and how near to such a point a way leads through its face, in radii of its
disk, or as far as its third neighbour of a like normal, where faces are narrow."""

LIKE, THIRD, ASKED = 30.0, 3, 48
"""Degrees between the normals of such neighbours at most, which of them is meant, and how many points are asked."""

TOGETHER = 500_000
"""Cells that are looked at at once."""

ROUNDS, HALF = 3, 0.3
"""How often samples are looked at whose winding number is not one half, and by how much it may differ."""

TWICE, PEELS, AMONG = 2, 30, 6
"""How often samples are looked at by both, and those with an open side at most each time; and how many of what is
beside one."""


def spread(points: Float, normals: Float) -> tuple[Float, Float]:
    """Return samples and unit normals, both of shape (M, 3), of the planes and cylinders that points lie on.

    Parameters
    ----------
    points, normals : arrays of shape (N, 3), unit normals
    """
    nothing = np.zeros((0, 3)), np.zeros((0, 3))
    if len(points) >= MOST_POINTS:
        return nothing
    density = Density(points)
    search = Search(density, NOISE * density.radius, np.random.default_rng(0))
    found = search.all(points, normals, ANGLE, [])
    found = [face for face in _with_small(search, normals, found) if isinstance(face.surface, Plane | Cylinder)]
    if not found:
        return nothing
    size = float(np.sqrt(np.pi * np.square(density.disks).sum() / min(max(ENOUGH, len(points)), MOST * len(points))))
    faces = _Faces(density, normals, found)
    covers = [faces.cover(number, size) for number in range(len(found))]
    samples, theirs = (np.concatenate(parts) for parts in zip(*((one.x, one.normals) for one in covers), strict=True))
    rest = search.left(found)
    areas = np.concatenate([np.full(len(one.x), one.chart.area) for one in covers])
    alone = areas, points[rest], normals[rest], density.disks[rest]
    kept: Mask = np.ones(len(samples), dtype=bool)
    for _ in range(TWICE):
        # What goes on beyond the edge of a sheet on both of its sides looks two-sided until it ends nowhere.
        kept = _without_open(covers, _two_sided(kept, samples, theirs, *alone), samples, points, size)
    kept &= ~_beyond(covers, kept, samples, theirs, size)
    kept &= np.concatenate([one.apart for one in covers])
    return samples[kept], theirs[kept]


def _owners(covers: list[_Cover]) -> Int:
    """Return the number of each sample's face, of shape (M,)."""
    return np.repeat(np.arange(len(covers)), [len(one.x) for one in covers])


def _beyond(covers: list[_Cover], kept: Mask, x: Float, normals: Float, size: float) -> Mask:
    """Return which samples lie beyond an edge, now that both of its faces are covered up to it, of shape (M,).

    Parameters
    ----------
    covers : of the faces
    kept : mask of shape (M,), of their samples, in order
    x, normals : arrays of shape (M, 3), the samples
    size : how far apart they are
    """
    face = _owners(covers)
    found = [
        _through(one.x, one.start, x[other], normals[other], np.full(int(other.sum()), BESIDE * size))
        for number, one in enumerate(covers)
        for other in [kept & (face != number)]
    ]
    return np.concatenate(found)


def _without_open(covers: list[_Cover], kept: Mask, x: Float, points: Float, size: float) -> Mask:
    """Return which samples stay when those far from points are taken away wherever nothing is beside them.

    Parameters
    ----------
    covers : of the faces
    kept : mask of shape (M,), of their samples, in order
    x : array of shape (M, 3), the samples
    points : array of shape (N, 3), that were scanned
    size : how far apart samples are
    """
    ends = np.cumsum([0, *(len(one.x) for one in covers)])
    face, kept = _owners(covers), kept.copy()
    beside = [one.beside() for one in covers]
    for _ in range(PEELS):
        before = int(kept.sum())
        rows = np.flatnonzero(kept)
        tree = cKDTree(np.concatenate([x[rows], points]))
        owner = np.concatenate([face[rows], np.full(len(points), -1)])
        for number, (one, (places, at)) in enumerate(zip(covers, beside, strict=True)):
            mine = slice(ends[number], ends[number + 1])
            far = np.flatnonzero(kept[mine] & ~one.sure)
            if not len(far):
                continue
            # A sample of the same face there, by its number, which is -1 where there is none, or something else.
            there = (at[far] >= 0) & kept[mine][at[far]]
            away, near = tree.query(places[far], list(range(1, AMONG + 1)), distance_upper_bound=BESIDE * size)
            known = np.isfinite(away)
            there |= (known & (owner[np.where(known, near, 0)] != number)).any(axis=2)
            kept[ends[number] + far[~there.all(axis=1)]] = False
        if int(kept.sum()) == before:
            break
    return kept


def _two_sided(
    kept: Mask, samples: Float, theirs: Float, areas: Float, rest: Float, normals: Float, disks: Float
) -> Mask:
    """Return which of the samples kept have the inside on one side and the outside on the other, of shape (M,).

    On a closed surface the winding number is one half. What goes on beyond an edge has the same on both sides.

    Parameters
    ----------
    kept : mask of shape (M,)
    samples, theirs : arrays of shape (M, 3), and their normals
    areas : array of shape (M,), that the samples stand for
    rest, normals : arrays of shape (K, 3), points that lie on no face, and their normals
    disks : array of shape (K,), radii of the disks that these stand for
    """
    areas = np.concatenate([areas, np.pi * disks**2])
    sources, directions = np.concatenate([samples, rest]), np.concatenate([theirs, normals])
    kept = kept.copy()
    for _ in range(ROUNDS):
        some = np.concatenate([kept, np.ones(len(rest), dtype=bool)])
        dipoles = directions[some] * (areas[some] / (4 * np.pi))[:, None]
        winding = winding_number(samples, sources[some], dipoles, np.sqrt(areas[some] / np.pi))
        kept &= np.abs(winding - 0.5) < HALF
    return kept


def _with_small(search: Search, normals: Float, found: list[Face]) -> list[Face]:
    """Return faces, and the planes of few points that are left, whose normals agree to a degree or two."""
    points, density = search.points, search.density
    left = search.left(found)
    if len(left) > MOST_LEFT:
        return found
    free = np.ones(len(left), dtype=bool)
    for at in range(len(left)):
        if not free[at]:
            continue
        plane = Plane(points[left[at]], normals[left[at]])
        rows = left[free & agreed(plane, points[left], normals[left], OFF * search.noise, EQUAL)]
        if len(rows) < FEW:
            continue
        near = np.unique(np.concatenate(density.tree.query_ball_point(points[rows], REACH * density.radius)))
        cosine = normals[near.astype(np.int64)] @ plane.direction
        if ((cosine < cosine_of(2 * EQUAL)) & (cosine > cosine_of(BENT))).any():
            continue
        free &= ~np.isin(left, rows)
        found = [*found, Face(plane, rows)]
    return found


@dataclass(frozen=True)
class _Faces:
    """Points with unit normals, and the faces that some of them lie on."""

    density: Density
    normals: Float
    found: list[Face]

    def cover(self, number: int, size: float) -> _Cover:
        """Return samples of a face, `size` apart, up to where other faces are."""
        face = self.found[number]
        own, tree = self.density.points[face.rows], cKDTree(self.density.points[face.rows])
        disks = self.density.disks[face.rows]
        reach = REACH * disks
        if len(own) < LEAST:
            reach = np.maximum(reach, tree.query(own, min(THIRD + 1, len(own)))[0][:, -1])
        assert isinstance(face.surface, Plane | Cylinder), "no others were kept"
        chart = _Chart.of(face.surface, size)
        cells = chart.wrapped(_around(chart.cells(own), np.minimum(reach / size, MOST_CELLS)))
        x = chart.places(cells)
        away, nearest = tree.query(x)
        kept = np.flatnonzero(away < reach[nearest])
        other = np.setdiff1d(np.arange(len(self.density.points)), face.rows)
        seen = self.density.points[other], self.normals[other], self._reaches[other]
        kept = kept[~_through(x[kept], own[nearest[kept]], *seen)]
        x, away, nearest = x[kept], away[kept], nearest[kept]
        sure, apart = away < SURE * disks[nearest], away > APART * size
        return _Cover(chart, cells[kept], x, face.surface.normal(x), own[nearest], sure, apart)

    @cached_property
    def _reaches(self) -> Float:
        """How near to each point a way leads through its face, of shape (N,)."""
        points, normals = self.density.points, self.normals
        away, near = self.density.tree.query(points, list(range(2, min(ASKED, len(points)) + 1)))
        alike = np.einsum("nkd,nd->nk", normals[near], normals) > cosine_of(LIKE)
        third = np.where(alike.cumsum(axis=1) >= THIRD, away, np.inf).min(axis=1)
        reaches: Float = np.maximum(THROUGH * self.density.disks, np.minimum(third, away[:, -1]))
        return reaches


@dataclass(frozen=True)
class _Chart:
    """Even coordinates of a surface, in cells.

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
    def of(cls, surface: Plane | Cylinder, size: float) -> _Chart:
        """Return the chart of a surface with cells of about a size."""
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
        beyond = points - self.surface.center
        across = beyond @ self.axes.T
        if isinstance(self.surface, Plane):
            return np.asarray(across / self.size)
        turn = np.arctan2(across[:, 1], across[:, 0]) / self._turn
        return np.stack([turn, beyond @ self.surface.axis / self.size], axis=1)

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
class _Cover:
    """Samples of a face.

    Parameters
    ----------
    chart : of the face
    cells : integer array of shape (M, 2)
    x, normals : arrays of shape (M, 3)
    start : array of shape (M, 3), the nearest point of the face to each
    sure, apart : masks of shape (M,), of those near points of the face, and of those not right beside one
    """

    chart: _Chart
    cells: Int
    x: Float
    normals: Float
    start: Float
    sure: Mask
    apart: Mask

    def beside(self) -> tuple[Float, Int]:
        """Return the places beside each sample, of shape (M, 4, 3), and the samples there, -1 for none, (M, 4)."""
        cells = self.cells[:, None] + np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
        places = self.chart.places(cells)
        if self.chart.around:
            cells[..., 0] %= self.chart.around
        table = {(one, other): row for row, (one, other) in enumerate(self.cells.tolist())}
        found = [table.get((one, other), -1) for one, other in cells.reshape(-1, 2).tolist()]
        return places, np.array(found, dtype=np.int64).reshape(-1, 4)


def _through(x: Float, start: Float, points: Float, normals: Float, reaches: Float) -> Mask:
    """Return whether ways from `start` to x, both of shape (M, 3), lead through the planes of points that are near.

    Parameters
    ----------
    points, normals : arrays of shape (K, 3), of other faces
    reaches : array of shape (K,), how near to each its plane is its face
    """
    if not len(points) or not len(x):
        return np.zeros(len(x), dtype=bool)
    _, near = cKDTree(points).query(x, list(range(1, min(OTHERS, len(points)) + 1)))
    there = np.einsum("mkd,mkd->mk", x[:, None] - points[near], normals[near])
    here = np.einsum("mkd,mkd->mk", start[:, None] - points[near], normals[near])
    crosses = there * here < 0
    share = np.where(crosses, here, 0.0) / np.where(crosses, here - there, 1.0)
    at = start[:, None] + share[..., None] * (x - start)[:, None]
    hit = crosses & (np.linalg.norm(at - points[near], axis=2) < reaches[near])
    return np.asarray(hit.any(axis=1))


def _around(cells: Float, reach: Float) -> Int:
    """Return the whole cells, of shape (M, 2), within a reach, of shape (K,), of some coordinates, of shape (K, 2)."""
    most = int(np.ceil(reach.max())) + 1
    steps = np.stack(np.meshgrid(*[np.arange(-most, most + 1)] * 2), axis=-1).reshape(-1, 2)
    found = []
    for rows in slices(len(cells), max(1, TOGETHER // len(steps))):
        there = np.rint(cells[rows])[:, None] + steps
        near = np.linalg.norm(there - cells[rows, None], axis=2) <= reach[rows, None]
        found.append(np.unique(there[near].astype(np.int64), axis=0))
    return np.unique(np.concatenate(found), axis=0)
