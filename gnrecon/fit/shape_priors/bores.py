"""Completes the walls of round bores where they were not scanned.

From outside a scanner sees little of a narrow bore: pieces of the wall at its ends, and of a wider one some sides. In
the middle of a gap between pieces the winding number is near one, as in the solid around it, so that nothing there
looks like a hole. The pieces show it: they lie on one cylinder and face its axis. Where this cylinder has no point, is
backed by solid, and encloses none, it is taken for the wall. Entries: `samples_on_bores`, and `in_bore_opening`, which
keeps the openings of bores from being closed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from gnrecon.fit.shape_priors.primitive_detection import detect_cylinders, meets_on_an_axis
from gnrecon.fit.shape_priors.primitives import Cylinder, cosine_of
from gnrecon.fit.shape_priors.prior_parameters import BoreParameters, DetectionParameters
from gnrecon.geometry.arrays import Float, Int, Mask
from gnrecon.geometry.signed_distance import CoarseDistance
from gnrecon.geometry.statistics import perpendicular, widest_gap
from gnrecon.runtime.chunks import slices
from gnrecon.runtime.parallel import map_in_threads


def samples_on_bores(
    points: Float,
    normals: Float,
    radius: float,
    max_height: float,
    coarse: CoarseDistance,
    parameters: BoreParameters = BoreParameters(),
) -> list[tuple[Float, Float]]:
    """Return samples and normals, both of shape (M, 3), of the walls of bores, for each bore with a gap.

    Parameters
    ----------
    points, normals : arrays of shape (N, 3), unit normals
    radius : of the disk that a point stands for
    max_height : of a point over the cylinder
    coarse : winding number of the scan
    parameters : of bores and their gaps
    """
    p, tree = parameters, cKDTree(points)
    widest = p.max_bore_radii * radius
    # Where points crowd, each has too many others within reach.
    while tree.count_neighbors(tree, 2.0 * widest) > p.max_pairs:
        widest /= 2.0
        if widest < p.detection.min_round_radii * radius:
            return []
    pairs = _pairs_on_bores(points, normals, tree, 2.0 * widest, 2.0 * max_height, p.detection)
    # A generator of its own, so that later draws are the same whether there are bores or not.
    rng = np.random.default_rng(0)
    rows, pairs = np.unique(pairs, return_inverse=True)
    cloud = points[rows], normals[rows], pairs.reshape(-1, 2), radius, max_height, rng, p.detection
    # What is open to one side is a groove or a fillet.
    found = detect_cylinders(*cloud, max_open_degrees=p.max_open_degrees)
    samples = []
    for one in found:
        wall = one.surface
        if isinstance(wall, Cylinder) and wall.side < 0 and wall.radius < widest:
            bore = _Bore.of(wall, one.points, min(2.0 * radius, p.max_spacing_share * wall.radius))
            unseen = bore.unseen(tree, coarse, radius, p)
            if len(unseen):
                samples.append((unseen, wall.normal(unseen)))
    return samples


def _pairs_on_bores(
    points: Float, normals: Float, tree: cKDTree, reach: float, tolerance: float, parameters: DetectionParameters
) -> Int:
    """Return pairs of rows, of shape (K, 2), within reach that may lie on one bore, among points that face another."""
    pairs = tree.query_pairs(reach, output_type="ndarray")

    def of(rows: slice) -> tuple[Int, Int]:
        """Return the pairs that face each other, and those that may lie on one bore."""
        one, other = pairs[rows].T
        n, m, offset = normals[one], normals[other], points[other] - points[one]
        cosine = np.einsum("kd,kd->k", n, m)
        # Both are in front of the other.
        concave = (np.einsum("kd,kd->k", offset, n) > 0) & (np.einsum("kd,kd->k", offset, m) < 0)
        opposed = concave & (cosine < cosine_of(parameters.max_pair_degrees))
        turned = concave & ~opposed & (cosine < cosine_of(parameters.min_pair_degrees))
        turned[turned] = meets_on_an_axis(offset[turned], n[turned], m[turned], tolerance)
        return pairs[rows][opposed], pairs[rows][turned]

    parts = map_in_threads(of, slices(len(pairs), 200_000))
    facing = np.zeros(len(points), dtype=bool)
    for opposed, _ in parts:
        facing[opposed] = True
    found = np.concatenate([pairs[:0], *(turned for _, turned in parts)])
    chosen: Int = found[facing[found].all(axis=1)]
    return chosen


@dataclass(frozen=True)
class _Bore:
    """A bore and places on its wall.

    Parameters
    ----------
    wall : its cylinder
    points : array of shape (N, 3), of the scan, on the wall
    rings : array of shape (rings, K, 3), places about a spacing apart, to a diameter beyond the points
    spacing : of the places
    """

    wall: Cylinder
    points: Float
    rings: Float
    spacing: float

    @classmethod
    def of(cls, wall: Cylinder, points: Float, spacing: float) -> _Bore:
        """Return the bore with places on its wall."""
        aside = perpendicular(wall.axis)
        aside /= np.linalg.norm(aside)
        count = round(2.0 * np.pi * wall.radius / spacing)
        turns = 2.0 * np.pi * np.arange(count)[:, None] / count
        ring = np.cos(turns) * aside + np.sin(turns) * np.cross(wall.axis, aside)
        height = (points - wall.center) @ wall.axis
        heights = np.arange(height.min() - 2.0 * wall.radius, height.max() + 2.0 * wall.radius, spacing)
        rings = wall.center + wall.radius * ring + heights[:, None, None] * wall.axis
        return cls(wall, points, rings, spacing)

    def unseen(self, tree: cKDTree, coarse: CoarseDistance, radius: float, parameters: BoreParameters) -> Float:
        """Return the places of its wall without points, of shape (M, 3).

        Parameters
        ----------
        tree : of all points of the scan
        coarse : winding number of the scan
        radius : of the disk that a point stands for
        parameters : of bores and their gaps
        """
        p, wall = parameters, self.wall
        offset = self.points - wall.center
        places = self.rings.reshape(-1, 3)
        behind = places - p.backing_radii * radius * wall.normal(places)
        solid = (coarse.winding_number(behind) > 0.5).reshape(self.rings.shape[:2])
        middle = self.rings.mean(axis=1)
        free = tree.query(middle)[0] > p.free_share * wall.radius
        passes = free & (solid.mean(axis=1) > 0.5)
        height = (middle - wall.center) @ wall.axis
        scanned = passes & (np.abs(height[:, None] - offset @ wall.axis).min(axis=1) < self.spacing)
        kept = scanned.copy()
        for gap in ndimage.find_objects(ndimage.label(passes & ~scanned)[0]):
            # It ends at scanned wall, in air or at something in the bore: else nothing shows how far the bore goes.
            first, last = gap[0].start, gap[0].stop
            ends = first > 0 and last < len(kept) and (scanned[first - 1] or scanned[last])
            kept[gap] = ends and (last - first) * self.spacing < 2.0 * p.max_gap_diameters * wall.radius
        # Mouths are often rounded or bevelled.
        kept &= ndimage.binary_erosion(passes)
        away = tree.query(places)[0].reshape(solid.shape)
        unseen: Float = self.rings[kept[:, None] & solid & (away > max(self.spacing, p.unseen_radii * radius))]
        return unseen


# Bore openings. A face that ends at a bore has a hole there, which looks like an unscanned part of the face. Points of
# the bore's wall, just behind the face, have normals that point to the middle of the hole from all around it: if the
# face were closed there, they would be inside the part.


def in_bore_opening(
    samples: Float,
    normals: Float,
    points: Float,
    point_normals: Float,
    *,
    search_distances: float = 1.5,
    group_distances: float = 1.6,
    min_group_cosine: float = 0.95,
) -> Mask:
    """Return which samples lie in the openings of bores, of shape (M,).

    Parameters
    ----------
    samples, normals : arrays of shape (M, 3), of extended faces
    points, point_normals : arrays of shape (N, 3), of the scan
    search_distances : how far around a sample wall points are looked for, in distances of its nearest point
    group_distances : how far from such a sample others of its face are in the opening too, in the same distances
    min_group_cosine : of the angle between the normals of one face
    """
    found = np.zeros(len(samples), dtype=bool)
    if not len(samples):
        return found
    tree, others = cKDTree(points), cKDTree(samples)
    away = tree.query(samples)[0]
    for row, near in enumerate(tree.query_ball_point(samples, search_distances * away)):
        if not found[row] and _is_walled(points[near] - samples[row], point_normals[near], normals[row]):
            same = np.array(others.query_ball_point(samples[row], group_distances * away[row]))
            found[same[normals[same] @ normals[row] > min_group_cosine]] = True
    return found


def _is_walled(
    offsets: Float, normals: Float, axis: Float, *, max_wall_cosine: float = 0.5, max_gap_degrees: float = 150.0
) -> bool:
    """Return whether walls behind the origin, along an axis, face it from all around.

    Parameters
    ----------
    offsets, normals : arrays of shape (N, 3), of points near the origin
    axis : array of shape (3,), the face's normal
    max_wall_cosine : of the angle between a wall's normal and the axis: walls may slope by 30 degrees
    max_gap_degrees : widest angle around the axis without a wall
    """
    wall = np.abs(normals @ axis) < max_wall_cosine
    wall &= (offsets @ axis < 0) & (np.einsum("nd,nd->n", normals, offsets) < 0)
    return bool(widest_gap(offsets[wall], axis) < np.radians(max_gap_degrees))
