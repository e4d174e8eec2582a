"""Hole completion: planes and cylinders of a machine part are extended across the holes of its scan until they meet.

A smooth field closes a hole like a membrane. Where an edge, a corner, or most of a bore is missing, that is far from
the part. A minimal cut (`min_cut`) of a lattice around the hole, between the cells that nearby points show to be inside
and outside, decides which parts of the extended primitives are surface. Where the cut follows none of them, no samples
are added, and the hole is closed smoothly. Walls of round bores are completed first (`bores`).

A hole is where the winding number is near one half although no point is near. Entry: `complete_holes`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from gnrecon.fit.shape_priors.bores import in_bore_opening, samples_on_bores
from gnrecon.fit.shape_priors.edge_completion import EdgeCompletion
from gnrecon.fit.shape_priors.min_cut import minimal_inside, shifted
from gnrecon.fit.shape_priors.primitive_detection import DetectedPrimitive, detect_primitives, planar_share
from gnrecon.fit.shape_priors.primitives import Primitive, is_inlier, project
from gnrecon.fit.shape_priors.prior_parameters import HoleCompletionParameters
from gnrecon.geometry.arrays import Float, Int, Mask
from gnrecon.geometry.signed_distance import Box, CoarseDistance, Density


@dataclass(frozen=True)
class HoleCompletion:
    """Samples, of shape (M, 3), and unit normals of the primitives extended across holes, and the number of holes."""

    points: Float
    normals: Float
    holes: int

    def __len__(self) -> int:
        return len(self.points)

    @classmethod
    def none(cls) -> HoleCompletion:
        """Return no samples."""
        return cls(np.zeros((0, 3)), np.zeros((0, 3)), 0)

    @classmethod
    def joined(cls, found: list[tuple[Float, Float]]) -> HoleCompletion:
        """Return the samples and normals of holes, each of shape (M, 3), as one; holes without any do not count."""
        some = [one for one in found if len(one[0])]
        if not some:
            return cls.none()
        points, normals = (np.concatenate(arrays) for arrays in zip(*some, strict=True))
        return cls(points, normals, len(some))

    def appended_to(self, points: Float, normals: Float) -> tuple[Float, Float]:
        """Return points and normals, of shape (N, 3), followed by the samples, of shape (N + M, 3)."""
        return np.concatenate([points, self.points]), np.concatenate([normals, self.normals])


def complete_holes(
    points: Float,
    normals: Float,
    exact: bool = True,
    parameters: HoleCompletionParameters = HoleCompletionParameters(),
) -> HoleCompletion:
    """Return samples of the planes and cylinders that extend across the holes of a scan.

    Parameters
    ----------
    points, normals : arrays of shape (N, 3), unit coordinates, outward unit normals
    exact : whether normals are reliable where points are sparse; estimated ones are not
    parameters : of the completion
    """
    if len(points) < parameters.min_points:
        return HoleCompletion.none()
    # Generators of its own, so that later draws are the same whether there are holes or not.
    rng = np.random.default_rng(0)
    scan = _HoleScan.of(points, normals, exact, rng, parameters)
    if not scan.is_machine_part(rng):
        return HoleCompletion.none()
    # First, as the walls of bores show what is around other holes.
    bores, total = HoleCompletion.joined(scan.samples_in_bores()), HoleCompletion.none()
    known, rng = bores.appended_to(points, normals), np.random.default_rng(0)
    for _ in range(parameters.passes):
        more = _one_pass(*total.appended_to(*known), scan.roughness, exact, rng, parameters)
        finished = len(more) <= parameters.min_gain_share * len(total)
        total = HoleCompletion(*total.appended_to(more.points, more.normals), max(total.holes, more.holes))
        if finished:
            break
    return HoleCompletion(*total.appended_to(bores.points, bores.normals), total.holes + bores.holes)


def are_in_a_hole(
    places: Float,
    points: Float,
    normals: Float,
    parameters: HoleCompletionParameters = HoleCompletionParameters(),
) -> bool:
    """Return whether any of some places, of shape (Q, 3), is in a hole of a scan that is not too small to have any.

    The other parameters are those of `complete_holes`.
    """
    if len(points) < parameters.min_points:
        return False
    scan = _HoleScan.of(points, normals, True, np.random.default_rng(0), parameters, roughness=0.0)
    return bool((np.abs(scan.winding_offset(places)) < parameters.max_winding_offset).any())


def _one_pass(
    points: Float,
    normals: Float,
    roughness: float,
    exact: bool,
    rng: np.random.Generator,
    parameters: HoleCompletionParameters,
) -> HoleCompletion:
    """Return the samples of one pass; `roughness` is that of the scan, the others are those of `complete_holes`."""
    scan = _HoleScan.of(points, normals, exact, rng, parameters, roughness)
    spacing = parameters.sample_spacing_radii * scan.density.radius * np.sqrt(len(scan.points) / len(points))
    found = HoleCompletion.joined([scan.samples_across(cells, spacing, rng) for cells in scan.holes()])
    kept = ~in_bore_opening(found.points, found.normals, points, normals)
    return HoleCompletion(found.points[kept], found.normals[kept], found.holes)


@dataclass(frozen=True)
class _HoleScan:
    """A scan with holes.

    Parameters
    ----------
    points, normals : arrays of shape (N, 3), in which holes are looked for
    dense_points, dense_normals : arrays of shape (K, 3), in which primitives are looked for
    density, coarse : of the former
    roughness : noise of the scan's positions, in radii of the dense points' disks
    exact, parameters : as in `complete_holes`
    """

    points: Float
    normals: Float
    dense_points: Float
    dense_normals: Float
    density: Density
    coarse: CoarseDistance
    roughness: float
    exact: bool
    parameters: HoleCompletionParameters

    @classmethod
    def of(
        cls,
        points: Float,
        normals: Float,
        exact: bool,
        rng: np.random.Generator,
        parameters: HoleCompletionParameters,
        roughness: float | None = None,
    ) -> _HoleScan:
        """Draw the points in which holes and primitives are looked for; by default, the roughness is measured."""
        drawn = rng.permutation(len(points))
        rows, dense = np.sort(drawn[: parameters.hole_points]), np.sort(drawn[: parameters.surface_points])
        density = Density(points[rows])
        coarse = CoarseDistance(points[rows], normals[rows], rng, density)
        drawn_points = points[rows], normals[rows], points[dense], normals[dense]
        if roughness is None:
            roughness = EdgeCompletion(*drawn_points[2:]).roughness
        return cls(*drawn_points, density, coarse, roughness, exact, parameters)

    def is_machine_part(self, rng: np.random.Generator) -> bool:
        """Return whether a large share of the points lies on planes, more than on a free-form shape by chance."""
        radius, p = self.density.radius, self.parameters
        share = planar_share(self.points, self.normals, radius, self._max_height(radius), rng, p.detection)
        return share > p.min_planar_share

    def _max_height(self, radius: float) -> float:
        """Return the largest height of a primitive's points over it, where points stand for disks of a radius."""
        p = self.parameters
        return radius * float(np.clip(p.height_roughness * self.roughness, p.min_height_radii, p.max_height_radii))

    def holes(self) -> list[Float]:
        """Return lattice cells in each hole, of shape (K, 3), the largest hole first."""
        p, box = self.parameters, Box.around(self.points, self.parameters.margin_units)
        # Where most points crowd in a small place, disks are tiny: the number of cells is bounded.
        least = float(np.prod(box.upper - box.lower) / p.max_lattice_cells) ** (1 / 3)
        lattice = _lattice(box.lower, box.upper, max(p.lattice_step_radii * self.density.radius, least))
        # First at every other node. Away from the points the winding number is harmonic, so that where all nodes around
        # are certain of one side, there is no hole between them.
        offset = self.winding_offset(lattice[::2, ::2, ::2])
        sides = np.where(np.abs(offset) > p.max_winding_offset + p.winding_slack, np.sign(offset), 0)
        certain = (ndimage.minimum_filter(sides, 3) == ndimage.maximum_filter(sides, 3)) & (sides != 0)
        rest = ~certain.repeat(2, 0).repeat(2, 1).repeat(2, 2)[tuple(map(slice, lattice.shape[:3]))]
        open_ = np.zeros(lattice.shape[:3], dtype=bool)
        open_[rest] = np.abs(self.winding_offset(lattice[rest])) < p.max_winding_offset
        number, count = ndimage.label(open_, structure=np.ones((3, 3, 3)))
        found = [lattice[number == one] for one in range(1, count + 1)]
        found = [h for h in found if len(h) >= p.min_hole_cells and np.ptp(h, axis=0).max() <= p.max_hole_units]
        return sorted(found, key=len, reverse=True)[: p.max_holes]

    def winding_offset(self, cells: Float) -> Float:
        """Return the winding number minus 1/2 at cells, of shape (..., 3); not a number where a point is near."""
        at = cells.reshape(-1, 3)
        far, *_ = self.coarse.size(at, self.parameters.hole_distance_radii)
        offset = np.full(len(at), np.nan)
        offset[far] = self.coarse.winding_number(at[far]) - 0.5
        return offset.reshape(cells.shape[:-1])

    @property
    def _dense_radius(self) -> float:
        """Radius of the disks for which the dense points stand."""
        return self.density.radius * float(np.sqrt(len(self.points) / len(self.dense_points)))

    def samples_in_bores(self) -> list[tuple[Float, Float]]:
        """Return samples and normals, both of shape (M, 3), of the unseen walls of bores."""
        radius = self._dense_radius
        dense = self.dense_points, self.dense_normals, radius, self._max_height(radius)
        return samples_on_bores(*dense, self.coarse, self.parameters.bores)

    def samples_across(self, hole_cells: Float, spacing: float, rng: np.random.Generator) -> tuple[Float, Float]:
        """Return samples and normals, both of shape (M, 3), of the primitives that extend across a hole."""
        radius, p, hole = self.density.radius, self.parameters, cKDTree(hole_cells)
        faces = self._faces_around(hole, rng)
        if not faces:
            return np.zeros((0, 3)), np.zeros((0, 3))
        lower, upper = hole_cells.min(axis=0) - p.room_radii * radius, hole_cells.max(axis=0) + p.room_radii * radius
        size = max(float((upper - lower).max()) / p.cut_cells, p.min_cell_radii * radius)
        lattice = _lattice(lower, upper, size)
        cells = lattice.reshape(-1, 3)
        signed = np.stack([face.surface.signed_distance(cells) for face in faces], axis=1)
        valid = np.stack([self._within_extension(face, cells) for face in faces], axis=1)
        shape = lattice.shape[:3]
        known = self._known_sides(cells, shape).reshape(shape)
        inside = minimal_inside(known, signed.reshape(*shape, -1), valid.reshape(*shape, -1))
        if encloses(inside, known < 0) or encloses(~inside, known > 0):
            return np.zeros((0, 3)), np.zeros((0, 3))
        # At least one sample a cell, and a bounded number.
        share = min(max(1, round(size / spacing)), p.max_samples_per_cell)
        primitives = [face.surface for face in faces]
        samples, normals = _samples_on_cut(inside, lattice, size, signed, valid, primitives, spacing, share)
        far = self.density.tree.query(samples)[0] > p.unseen_radii * radius
        far &= hole.query(samples)[0] < p.room_radii * radius
        return samples[far], normals[far]

    def _faces_around(self, hole: cKDTree, rng: np.random.Generator) -> list[DetectedPrimitive]:
        """Return the primitives of which some points are near the cells of a hole.

        Where normals are exact, the points that are left are searched again for faces sampled less densely.
        """
        radius, p = self.density.radius, self.parameters
        distance = hole.query(self.dense_points)[0] / radius
        around = distance < p.search_radii
        disk = self._dense_radius
        proposing = distance[around] < p.touch_radii
        points, normals, height = self.dense_points[around], self.dense_normals[around], self._max_height(disk)
        faces = detect_primitives(points, normals, proposing, disk, height, rng, p.detection)
        if self.exact:
            left = np.ones(len(points), dtype=bool)
            for face in faces:
                left &= ~is_inlier(face.surface, points, normals, height)
            rest, sparse = (points[left], normals[left], proposing[left]), replace(p.detection, sparse=True)
            faces = faces + detect_primitives(*rest, disk, height, rng.spawn(1)[0], sparse)
        touching = [(hole.query(face.points)[0] < p.touch_radii * radius).sum() for face in faces]
        return [face for face, count in zip(faces, touching, strict=True) if count >= p.min_touching_points]

    def _within_extension(self, face: DetectedPrimitive, cells: Float) -> Mask:
        """Return which cells, of shape (Q, 3), are near enough to a primitive's points for it to extend there."""
        p = self.parameters
        narrow = np.sqrt(np.linalg.eigvalsh(np.cov(face.points.T))[1].clip(0.0))
        reach = max(
            p.extension_widths * p.width_deviations * float(narrow), p.hole_distance_radii * self.density.radius
        )
        reached: Mask = cKDTree(face.points).query(cells)[0] < reach
        return reached

    def _known_sides(self, cells: Float, shape: tuple[int, ...]) -> Int:
        """Return 1 for cells, of shape (Q, 3), that are certainly inside, -1 for those outside, and 0 elsewhere."""
        radius, p = self.density.radius, self.parameters
        distance, near = self.density.tree.query(cells, list(range(1, p.side_points + 1)))
        height = np.einsum("qkd,qkd->qk", cells[:, None] - self.points[near], self.normals[near])
        agreeing = np.abs(np.sign(height).sum(axis=1)) == p.side_points
        close = distance[:, 0] < p.side_reach_radii * radius
        by_points = close & agreeing & (np.abs(height).min(axis=1) > p.min_side_radii * radius)
        winding = self.coarse.winding_number(cells)
        by_winding = ~close & (np.abs(winding - 0.5) > 0.5 - p.max_winding_error)
        border = np.ones(shape, dtype=bool)
        border[1:-1, 1:-1, 1:-1] = False
        side = np.where(winding > 0.5, 1, -1)
        known: Int = np.where(by_points, -np.sign(height[:, 0]), np.where(by_winding | border.ravel(), side, 0)).astype(
            int
        )
        return known


def encloses(sides: Mask, known: Mask, *, max_cells: int = 20) -> bool:
    """Return whether a cut's side encloses cells known to be on the other, which no scanner could have reached.

    Parameters
    ----------
    sides, known : masks of shape (a, b, c), of the cells on a side, and of those known to be off it
    max_cells : known cells that may be enclosed by chance
    """
    number, _ = ndimage.label(~sides)
    border = np.ones(sides.shape, dtype=bool)
    border[1:-1, 1:-1, 1:-1] = False
    held = np.bincount(number[known & ~sides])
    held[np.unique(number[border & ~sides])] = 0
    return bool(held[1:].max(initial=0) >= max_cells)


def _samples_on_cut(
    inside: Mask,
    lattice: Float,
    size: float,
    signed: Float,
    valid: Mask,
    primitives: list[Primitive],
    spacing: float,
    share: int,
) -> tuple[Float, Float]:
    """Return samples, and normals, of primitives where a cut follows them.

    Parameters
    ----------
    inside : mask of shape (a, b, c), the cut
    lattice : array of shape (a, b, c, 3), the cells' centres, `size` apart
    signed, valid : arrays of shape (Q, primitives), as of `minimal_inside`
    primitives : that the cut may follow
    spacing : how far apart the samples are at least
    share : samples along a cell's side before that
    """
    cells = lattice.reshape(-1, 3)
    inner, outer, offset = _cut_faces(inside, size, (np.arange(share) + 0.5) / share - 0.5)
    points, normals = [], []
    for number, primitive in enumerate(primitives):
        on = (signed[inner, number] < 0) & (signed[outer, number] >= 0) & valid[inner, number]
        x = ((cells[inner[on]] + cells[outer[on]])[:, None] / 2 + offset[on]).reshape(-1, 3)
        x = project(primitive, x)
        normal = primitive.normal(x)
        # Beyond an edge the cut follows another primitive: both sides of this one are outside there, or both inside.
        below, above = (_is_inside(inside, lattice, size, x + by * size * normal) for by in (-1, 1))
        x, normal = x[below & ~above], normal[below & ~above]
        _, first = np.unique(np.floor(x / spacing), axis=0, return_index=True)
        points.append(x[first])
        normals.append(normal[first])
    return np.concatenate(points), np.concatenate(normals)


def _cut_faces(inside: Mask, size: float, fine: Float) -> tuple[Int, Int, Float]:
    """Return the pairs of neighbouring cells that a cut separates, and samples of the square between them.

    Returns
    -------
    inner, outer : arrays of shape (pairs,), numbers of the cells
    offset : array of shape (pairs, S, 3), relative to the middle of both; `fine` are coordinates, in cells
    """
    numbers, is_inner = np.arange(inside.size).reshape(inside.shape), inside.ravel()
    start, end, offset = [], [], []
    for axis in range(3):
        one, other = shifted(numbers, tuple(int(axis == k) for k in range(3)))
        square = np.zeros((len(fine), len(fine), 3))
        square[..., (axis + 1) % 3], square[..., (axis + 2) % 3] = size * fine[:, None], size * fine[None]
        for inner, outer in ((one, other), (other, one)):
            cut = is_inner[inner] & ~is_inner[outer]
            start.append(inner[cut])
            end.append(outer[cut])
            offset.append(np.repeat(square.reshape(1, -1, 3), int(cut.sum()), axis=0))
    return np.concatenate(start), np.concatenate(end), np.concatenate(offset)


def _is_inside(inside: Mask, lattice: Float, size: float, x: Float) -> Mask:
    """Return whether the cells nearest to x, of shape (Q, 3), are inside."""
    at = np.rint((x - lattice[0, 0, 0]) / size).astype(int).clip(0, np.array(inside.shape) - 1)
    sides: Mask = inside[at[:, 0], at[:, 1], at[:, 2]]
    return sides


def _lattice(lower: Float, upper: Float, size: float) -> Float:
    """Return the points of a lattice of cells of a size that covers a box, of shape (a, b, c, 3)."""
    axes = [np.arange(low, high + size, size) for low, high in zip(lower, upper, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
