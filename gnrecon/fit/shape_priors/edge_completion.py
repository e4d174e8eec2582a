"""Samples added where faces meet at edges: each face is continued to its edge, and gaps within it are halved.

A sum of smooth features that knows faces by scattered points only rounds the edge between them over the points'
spacing, and swings on both sides of it. Where two neighbours' normals show an edge between them, the planes through
both meet in a line, and each point's face reaches from it to that line; a sample near the line says so. Between
neighbours of one face a sample lies on the curve through both that is perpendicular to their normals. It is exact on
planes, and of fourth order in their distance on round cylinders. Twice the samples tell shorter features apart, so
that the edge is sharper.

A smooth shape has no edges to continue: a sample is left out where a scanned point beside it contradicts, because it
has a normal between the two faces', or lies off the plane.
Source: the resampling towards edges is that of Huang, Wu, Gong, Cohen-Or, Ascher and Zhang, Edge-aware point set
resampling (2013); the curve is an edge of Vlachos, Peters, Boyd and Mitchell, Curved PN triangles (2001), sections 3.1
and 3.3.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from gnrecon.fit.shape_priors.primitives import cosine_of
from gnrecon.geometry.arrays import Float, Int, Mask
from gnrecon.geometry.signed_distance import Density

NEAREST, REACH = 40, 3.0
"""Most neighbours of a point, and how far they are at most, in radii of its disk."""

ONE_FACE, APART, OPPOSED = 15.0, 35.0, 150.0
"""Degrees between two normals up to which they belong to one face, and between which there is an edge between them."""

LEAST_FACE, FLAT = 3, 0.25
"""Least neighbours of a point on its face, and their mean height over its plane at most, in radii of its disk."""

FARTHEST, ASIDE, NEAREST_EDGE = 2.5, 1.5, 0.15
"""How far the edge may be from a point, how far along it the other face's point may be, and how near the edge is that
needs no sample, in radii of the point's disk."""

TOWARDS = 0.8
"""How far towards the edge a sample lies."""

OTHER_FACE = 37.0
"""Degrees between the normals of two other faces of which a point may be continued to both."""

BESIDE, OFF = 1.0, 0.15
"""How near a scanned point is that may contradict, and how far off the plane it is then, in radii of a disk."""

APART_EDGE, APART_FACE = 0.35, 0.5
"""Least distance of a sample from others of its face, in radii of a disk: near edges, and between points."""

WITHIN, BETWEEN, CURVED = 2.0, 25.0, 0.2
"""Distance of two points of a face, in radii of a disk, degrees between their normals, and their mean height over each
other's planes, halved, at most, for a sample between them."""


def over_planes(points: Float, normals: Float, rows: slice, near: Int) -> tuple[Float, Float]:
    """Return the height of each neighbour over a point's plane, and of the point over the neighbour's, of shape (R, k).

    Parameters
    ----------
    points, normals : arrays of shape (N, 3), unit normals
    rows : which R of the points
    near : array of shape (R, k), rows of their neighbours
    """
    beyond = points[near] - points[rows, None]
    return np.einsum("ikd,id->ik", beyond, normals[rows]), -np.einsum("ikd,ikd->ik", beyond, normals[near])


class Faces:
    """The faces of a scan, as its points and their neighbours tell them.

    Parameters
    ----------
    points, normals : arrays of shape (N, 3), unit normals
    """

    def __init__(self, points: Float, normals: Float) -> None:
        self.points, self.normals = points, normals
        self.density = Density(points)
        self.disks = self.density.disks
        ranks = list(range(2, min(NEAREST + 1, len(points)) + 1))
        self.distance, self.near = self.density.tree.query(points, ranks)
        self.cosine = np.einsum("ikd,id->ik", normals[self.near], normals)
        self.height, self.own = over_planes(points, normals, slice(None), self.near)

    @cached_property
    def roughness(self) -> float:
        """Mean height of neighbours of one face over each other's planes, halved, in radii of a disk.

        It is nothing on planes, spheres and round cylinders, so that what it tells is noise.
        """
        row, rank = np.nonzero(self._within)
        return float((self._bent[row, rank] / self.disks[row]).mean()) if len(row) else np.inf

    @cached_property
    def on_faces(self) -> Mask:
        """Which points lie on a face with some of their neighbours, of shape (N,); outliers do not."""
        face = self._close & (self.cosine > cosine_of(ONE_FACE))
        alike = face.sum(axis=1)
        rough = np.where(face, np.abs(self.height), 0.0).sum(axis=1) / np.maximum(alike, 1)
        on_faces: Mask = (alike >= LEAST_FACE) & (rough < FLAT * self.disks)
        return on_faces

    @cached_property
    def bend(self) -> float:
        """Median angle between the normals of a point and its nearest neighbour on its face, in degrees."""
        row, rank = np.nonzero(self._within)
        first = np.unique(row, return_index=True)[1]
        cosine = self.cosine[row[first], rank[first]].clip(-1.0, 1.0)
        return float(np.degrees(np.median(np.arccos(cosine)))) if len(row) else np.inf

    @cached_property
    def _close(self) -> Mask:
        close: Mask = self.distance < REACH * self.disks[:, None]
        return close

    @cached_property
    def _within(self) -> Mask:
        """Which neighbours are near and of one face, of shape (N, k)."""
        apart = (self.distance > 0) & (self.distance < WITHIN * self.disks[:, None])
        near: Mask = apart & (self.cosine > cosine_of(BETWEEN))
        return near

    @cached_property
    def _bent(self) -> Float:
        bent: Float = np.abs(self.height - self.own) / 2
        return bent

    def more(self, gaps: bool = True) -> tuple[Float, Float, float]:
        """Return samples between points of a face and near its edges, and how far edges could be trusted.

        Parameters
        ----------
        gaps : whether those between points are wanted, too

        Returns
        -------
        samples, normals : arrays of shape (M, 3)
        agreed : share of the samples near edges that no scanned point contradicts
        """
        samples, normals, disks, agreed = self.towards_edges()
        samples, normals = self.thinned(samples, normals, disks, APART_EDGE)
        if not gaps:
            return samples, normals, agreed
        within = self.thinned(*self.between(), APART_FACE, (samples, normals))
        return np.concatenate([samples, within[0]]), np.concatenate([normals, within[1]]), agreed

    def towards_edges(self) -> tuple[Float, Float, Float, float]:
        """Return samples near edges, normals, disks of the points continued to them, and the share that is kept."""
        # Both points are in front of the other's plane, or both behind: else the faces do not meet between them.
        turned = (self.cosine < cosine_of(APART)) & (self.cosine > cosine_of(OPPOSED))
        meet = self._close & turned & (self.height * self.own > 0)
        i, rank = np.nonzero(meet & self.on_faces[:, None] & self.on_faces[self.near])
        j = self.near[i, rank]
        x, n, y, m = self.points[i], self.normals[i], self.points[j], self.normals[j]
        along = np.cross(n, m)
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        across = np.cross(along, n)
        step = _dot(y - x, m) / _dot(across, m)
        edge = x + step[:, None] * across
        aside, far = np.abs(_dot(y - x, along)), np.linalg.norm(edge - y, axis=1)
        size = self.disks[i]
        good = (np.abs(step) < FARTHEST * size) & (far < FARTHEST * size + aside) & (aside < ASIDE * size)
        i, j, far, aside, step, across = (values[good] for values in (i, j, far, aside, step, across))
        best = self._two_faces(i, j, aside + 0.5 * far)
        best = best[np.abs(step[best]) > NEAREST_EDGE * self.disks[i[best]]]
        i, j = i[best], j[best]
        samples = self.points[i] + TOWARDS * step[best, None] * across[best]
        kept = self._uncontradicted(samples, i, j)
        agreed = len(kept) / len(samples) if len(samples) else 1.0
        return samples[kept], self.normals[i[kept]], self.disks[i[kept]], agreed

    def between(self) -> tuple[Float, Float, Float]:
        """Return samples between neighbours of one face, their normals and disks."""
        i, rank = np.nonzero(self._within & (self._bent < CURVED * self.disks[:, None]))
        j = self.near[i, rank]
        # Each pair once, where the neighbourhood is mutual.
        first = np.unique(np.stack([np.minimum(i, j), np.maximum(i, j)]), axis=1)
        i, j = first[0], first[1]
        n, m, d = self.normals[i], self.normals[j], self.points[j] - self.points[i]
        bend = _dot(d, m)[:, None] * m - _dot(d, n)[:, None] * n
        samples = (self.points[i] + self.points[j]) / 2 + bend / 8
        normal = n + m - 2 * (_dot(d, n + m) / _dot(d, d))[:, None] * d
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        return samples, normal, self.disks[i]

    def thinned(
        self, samples: Float, normals: Float, disks: Float, apart: float, others: tuple[Float, Float] | None = None
    ) -> tuple[Float, Float]:
        """Return those samples, and their normals, that lie some disks apart from points, others and each other."""
        points, like = self.points, self.normals
        if others is not None:
            points, like = np.concatenate([points, others[0]]), np.concatenate([like, others[1]])
        free = np.ones(len(samples), dtype=bool)
        row, col = _pairs(cKDTree(points), samples, apart * disks)
        free[row[_dot(like[col], normals[row]) > cosine_of(OTHER_FACE)]] = False
        samples, normals, disks = samples[free], normals[free], disks[free]
        row, col = _pairs(cKDTree(samples), samples, apart * disks) if len(samples) else (np.zeros(0, int),) * 2
        clash = (row != col) & (_dot(normals[row], normals[col]) > cosine_of(OTHER_FACE))
        row, col = row[clash], col[clash]
        ends = np.searchsorted(row, np.arange(len(samples) + 1))
        kept = np.ones(len(samples), dtype=bool)
        for sample in range(len(samples)):
            if kept[sample]:
                kept[col[ends[sample] : ends[sample + 1]]] = False
        return samples[kept], normals[kept]

    def _two_faces(self, i: Int, j: Int, cost: Float) -> Int:
        """Return the pairs of each point with its best neighbour across an edge, and with the best of another face."""
        order = np.lexsort((cost, i))
        _, at = np.unique(i[order], return_index=True)
        first = order[at]
        chosen = np.full(len(self.points), -1)
        chosen[i[first]] = j[first]
        other = order[_dot(self.normals[j[order]], self.normals[chosen[i[order]]]) < cosine_of(OTHER_FACE)]
        _, at = np.unique(i[other], return_index=True)
        return np.concatenate([first, other[at]])

    def _uncontradicted(self, samples: Float, i: Int, j: Int) -> Int:
        """Return the samples beside which every scanned point lies on one of the two faces, or on quite another."""
        row, col = _pairs(self.density.tree, samples, BESIDE * self.disks[i])
        normal = self.normals[col]
        mine, others = _dot(normal, self.normals[i[row]]), _dot(normal, self.normals[j[row]])
        off = np.abs(_dot(self.points[col] - samples[row], self.normals[i[row]])) > OFF * self.disks[i[row]]
        bad = (mine > cosine_of(ONE_FACE)) & off
        bad |= (np.maximum(mine, others) < cosine_of(ONE_FACE)) & (np.maximum(mine, others) > cosine_of(APART))
        return np.setdiff1d(np.arange(len(samples)), row[bad])


def _dot(a: Float, b: Float) -> Float:
    product: Float = np.einsum("kd,kd->k", a, b)
    return product


def _pairs(tree: cKDTree, samples: Float, reach: Float) -> tuple[Int, Int]:
    """Return rows of samples, in order, and of the tree's points within the reach of each."""
    found = tree.query_ball_point(samples, reach) if len(samples) else []
    rows = np.repeat(np.arange(len(samples)), [len(near) for near in found])
    return rows, np.fromiter((n for near in found for n in sorted(near)), dtype=np.int64, count=len(rows))
