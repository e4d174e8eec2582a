"""Edge completion: samples that extend each face to the edge at which it meets another, and halve gaps within faces.

A sum of smooth features that sees faces as scattered points only rounds the edge between them over their spacing, and
oscillates on both sides of it. Where two neighbours' normals show an edge between them, their planes meet in a line,
and each point's face reaches to that line; a sample near the line says so. Between neighbours of one face a sample lies
on the curve through both that is perpendicular to their normals. It is exact on planes, and of fourth order in their
distance on round cylinders. Denser samples resolve shorter features, so that the edge is sharper.

A smooth shape has no edges to complete: a sample is dropped where a scanned point nearby contradicts it, because its
normal is between those of both faces, or it lies off the plane.
Sources: resampling towards edges: Huang, Wu, Gong, Cohen-Or, Ascher and Zhang, Edge-aware point set resampling (2013);
the curve is an edge of Vlachos, Peters, Boyd and Mitchell, Curved PN triangles (2001), sections 3.1 and 3.3.
Entry: `EdgeCompletion.samples`.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from gnrecon.fit.shape_priors.primitives import cosine_of
from gnrecon.fit.shape_priors.prior_parameters import EdgeParameters
from gnrecon.geometry.arrays import Float, Int, Mask
from gnrecon.geometry.signed_distance import Density


def heights_over_planes(points: Float, normals: Float, rows: slice, near: Int) -> tuple[Float, Float]:
    """Return the height of each neighbour over a point's plane, and of the point over the neighbour's, of shape (R, k).

    Parameters
    ----------
    points, normals : arrays of shape (N, 3), unit normals
    rows : which R of the points
    near : array of shape (R, k), rows of their neighbours
    """
    beyond = points[near] - points[rows, None]
    return np.einsum("ikd,id->ik", beyond, normals[rows]), -np.einsum("ikd,ikd->ik", beyond, normals[near])


class EdgeCompletion:
    """The faces of a scan by its points' neighbourhoods, and samples that complete them.

    Parameters
    ----------
    points, normals : arrays of shape (N, 3), unit normals
    parameters : of the completion
    """

    def __init__(self, points: Float, normals: Float, parameters: EdgeParameters = EdgeParameters()) -> None:
        self.points, self.normals, self.parameters = points, normals, parameters
        self.density = Density(points)
        self.disks = self.density.disks
        ranks = list(range(2, min(parameters.neighbours + 1, len(points)) + 1))
        self.distance, self.near = self.density.tree.query(points, ranks)
        self.cosine = np.einsum("ikd,id->ik", normals[self.near], normals)
        self.height, self.opposite_height = heights_over_planes(points, normals, slice(None), self.near)

    @cached_property
    def roughness(self) -> float:
        """Mean of half the difference of neighbours' heights over each other's planes, in radii of a disk.

        It is zero on planes, spheres and round cylinders, so that it measures noise.
        """
        row, rank = np.nonzero(self._on_same_face)
        return float((self._curvature_height[row, rank] / self.disks[row]).mean()) if len(row) else np.inf

    @cached_property
    def on_faces(self) -> Mask:
        """Which points lie on a face with some of their neighbours, of shape (N,); outliers do not."""
        p = self.parameters
        face = self._close & (self.cosine > cosine_of(p.same_face_degrees))
        alike = face.sum(axis=1)
        rough = np.where(face, np.abs(self.height), 0.0).sum(axis=1) / np.maximum(alike, 1)
        on_faces: Mask = (alike >= p.min_face_neighbours) & (rough < p.max_face_height_radii * self.disks)
        return on_faces

    @cached_property
    def bend(self) -> float:
        """Median angle between the normals of a point and its nearest neighbour on its face, in degrees."""
        row, rank = np.nonzero(self._on_same_face)
        first = np.unique(row, return_index=True)[1]
        cosine = self.cosine[row[first], rank[first]].clip(-1.0, 1.0)
        return float(np.degrees(np.median(np.arccos(cosine)))) if len(row) else np.inf

    @cached_property
    def _close(self) -> Mask:
        """Which neighbours are near, of shape (N, k)."""
        close: Mask = self.distance < self.parameters.reach_radii * self.disks[:, None]
        return close

    @cached_property
    def _on_same_face(self) -> Mask:
        """Which neighbours are near and of one face, of shape (N, k)."""
        apart = (self.distance > 0) & (self.distance < self.parameters.midpoint_reach_radii * self.disks[:, None])
        near: Mask = apart & (self.cosine > cosine_of(self.parameters.midpoint_degrees))
        return near

    @cached_property
    def _curvature_height(self) -> Float:
        """Half the difference of neighbours' heights over each other's planes, of shape (N, k); zero on spheres."""
        bent: Float = np.abs(self.height - self.opposite_height) / 2
        return bent

    def samples(self, gaps: bool = True) -> tuple[Float, Float, float]:
        """Return samples between points of a face and near its edges, and how well the points agree with these.

        Parameters
        ----------
        gaps : whether samples between points are added, too

        Returns
        -------
        samples, normals : arrays of shape (M, 3)
        agreement : share of the samples near edges that no scanned point contradicts
        """
        samples, normals, disks, agreement = self.edge_samples()
        samples, normals = self.thinned(samples, normals, disks, self.parameters.edge_spacing_radii)
        if not gaps:
            return samples, normals, agreement
        within = self.thinned(*self.midpoints(), self.parameters.face_spacing_radii, (samples, normals))
        return np.concatenate([samples, within[0]]), np.concatenate([normals, within[1]]), agreement

    def edge_samples(self) -> tuple[Float, Float, Float, float]:
        """Return samples near edges, normals, disks of the points extended to them, and the share not contradicted."""
        p = self.parameters
        # Both points are in front of the other's plane, or both behind: otherwise the faces do not meet between them.
        turned = (self.cosine < cosine_of(p.edge_degrees)) & (self.cosine > cosine_of(p.opposed_degrees))
        meet = self._close & turned & (self.height * self.opposite_height > 0)
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
        good = (np.abs(step) < p.max_edge_radii * size) & (far < p.max_edge_radii * size + aside)
        good &= aside < p.max_aside_radii * size
        i, j, far, aside, step, across = (values[good] for values in (i, j, far, aside, step, across))
        best = self._best_pairs(i, j, aside + 0.5 * far)
        best = best[np.abs(step[best]) > p.min_edge_radii * self.disks[i[best]]]
        i, j = i[best], j[best]
        samples = self.points[i] + p.edge_fraction * step[best, None] * across[best]
        kept = self._uncontradicted(samples, i, j)
        agreement = len(kept) / len(samples) if len(samples) else 1.0
        return samples[kept], self.normals[i[kept]], self.disks[i[kept]], agreement

    def midpoints(self) -> tuple[Float, Float, Float]:
        """Return samples between neighbours of one face, their normals and disks."""
        flat = self._curvature_height < self.parameters.midpoint_height_radii * self.disks[:, None]
        i, rank = np.nonzero(self._on_same_face & flat)
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
        """Return those samples, and their normals, that are some radii apart from points, others and each other.

        Only points and samples of the same face count, by their normals.
        """
        same_face = cosine_of(self.parameters.other_face_degrees)
        points, like = self.points, self.normals
        if others is not None:
            points, like = np.concatenate([points, others[0]]), np.concatenate([like, others[1]])
        free = np.ones(len(samples), dtype=bool)
        row, col = _pairs(cKDTree(points), samples, apart * disks)
        free[row[_dot(like[col], normals[row]) > same_face]] = False
        samples, normals, disks = samples[free], normals[free], disks[free]
        row, col = _pairs(cKDTree(samples), samples, apart * disks) if len(samples) else (np.zeros(0, int),) * 2
        clash = (row != col) & (_dot(normals[row], normals[col]) > same_face)
        row, col = row[clash], col[clash]
        ends = np.searchsorted(row, np.arange(len(samples) + 1))
        kept = np.ones(len(samples), dtype=bool)
        for sample in range(len(samples)):
            if kept[sample]:
                kept[col[ends[sample] : ends[sample + 1]]] = False
        return samples[kept], normals[kept]

    def _best_pairs(self, i: Int, j: Int, cost: Float) -> Int:
        """Return the pairs of each point with its best neighbour across an edge, and with the best of another face."""
        order = np.lexsort((cost, i))
        _, at = np.unique(i[order], return_index=True)
        first = order[at]
        chosen = np.full(len(self.points), -1)
        chosen[i[first]] = j[first]
        cosine = _dot(self.normals[j[order]], self.normals[chosen[i[order]]])
        other = order[cosine < cosine_of(self.parameters.other_face_degrees)]
        _, at = np.unique(i[other], return_index=True)
        return np.concatenate([first, other[at]])

    def _uncontradicted(self, samples: Float, i: Int, j: Int) -> Int:
        """Return the samples next to which every scanned point lies on one of the two faces, or on a third one."""
        p = self.parameters
        row, col = _pairs(self.density.tree, samples, p.contradiction_radii * self.disks[i])
        normal = self.normals[col]
        mine, others = _dot(normal, self.normals[i[row]]), _dot(normal, self.normals[j[row]])
        height = np.abs(_dot(self.points[col] - samples[row], self.normals[i[row]]))
        bad = (mine > cosine_of(p.same_face_degrees)) & (height > p.contradiction_height_radii * self.disks[i[row]])
        either = np.maximum(mine, others)
        bad |= (either < cosine_of(p.same_face_degrees)) & (either > cosine_of(p.edge_degrees))
        return np.setdiff1d(np.arange(len(samples)), row[bad])


def _dot(a: Float, b: Float) -> Float:
    product: Float = np.einsum("kd,kd->k", a, b)
    return product


def _pairs(tree: cKDTree, samples: Float, reach: Float) -> tuple[Int, Int]:
    """Return rows of samples, in order, and of the tree's points within the reach of each."""
    found = tree.query_ball_point(samples, reach) if len(samples) else []
    rows = np.repeat(np.arange(len(samples)), [len(near) for near in found])
    return rows, np.fromiter((n for near in found for n in sorted(near)), dtype=np.int64, count=len(rows))
