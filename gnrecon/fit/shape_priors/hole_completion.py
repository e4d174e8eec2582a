"""Faces continued across holes: what was not seen of a made thing goes on as what was seen beside it.

A smooth field closes a hole as a film would. Where the hole takes an edge, a corner, or most of a bore, that is far
from the thing: its planes and round cylinders (`primitives`) go on until they meet. Which parts of them are surface is
told by a minimal cut (`min_cut`) of a lattice about the hole, between what the points beside it say of their two sides.
Where the cut runs along none of them, nothing is said, and the hole is closed smoothly as before.

A hole is where the winding number is near one half although no point is near.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from gnrecon.fit.shape_priors.edge_completion import Faces
from gnrecon.fit.shape_priors.min_cut import minimal_inside, shifted
from gnrecon.fit.shape_priors.primitives import Seen, Surface, Wanted, agreed, feet, planar_share, surfaces
from gnrecon.geometry.arrays import Float, Int, Mask
from gnrecon.geometry.signed_distance import Box, CoarseDistance, Density
from gnrecon.geometry.statistics import widest_gap

MOST_POINTS, CLOSER = 6000, 15_000
"""Points that are looked at for holes, and for surfaces; holes that so many do not show are small."""

PASSES, FEW = 3, 0.05
"""How often holes are looked for, as what was continued shows where other surfaces go on; and the share that a pass
must add for another."""

FEWEST, MADE = 50, 0.2
"""Points below which nothing is said, and the least share of them on planes where a shape is a made one: 0.4 to 1 on
machine parts, 0.1 at most on statues and castings of free form."""

STEP, MOST_CELLS, MARGIN = 2.0, 500_000, 0.1
"""Cell of the lattice in which holes are looked for, in radii of a disk, about how many cells it has at most, and how
far it reaches beyond the points."""

FAR, DOUBTFUL = 3.0, 0.3
"""How far the points are from a hole, in radii of a disk, and its winding number from one half."""

LEAST_CELLS, MOST_HOLES, WIDEST = 12, 16, 1.2
"""Least cells of a hole, most holes, and how wide one is at most: what is wider is a side that nobody scanned."""

CELLS, FINEST, ROOM = 26, 0.8, 4.0
"""Cells along a hole's longest side, their least size and the room beside the hole, in radii of a disk."""

BESIDE, SIDES, CLEAR = 2.5, 3, 0.3
"""How near points tell of sides, how many of them must agree, and how far off their planes, in radii of a disk."""

CERTAIN = 0.02
"""Winding numbers that differ no more from 0 or 1 are sure, away from the points."""

AROUND, TOUCH, TOUCHING, REACH = 12.0, 6.0, 6, 3.0
"""How near a hole surfaces are looked for, and how near some of their points are, in radii of a disk; how many; and how
far a surface goes on, in its own widths."""

OFF, NOISE = (0.3, 0.8), 2.5
"""Least and most height of a surface's points over it, in radii of a disk; between, so many times their roughness."""

SHUT = 20
"""Known cells that a cut may shut away at most, by chance."""

WIDTH = 3.5
"""Width of a surface, in standard deviations of its points along the lesser of its two directions."""

UNSEEN = 2.0
"""How far from all points a sample is, in radii of a disk."""

SPACING, MOST_ALONG = 2.0, 24
"""Distance of samples, in radii of a scanned point's disk: as dense as those; and most of them along a cell's side."""


@dataclass(frozen=True)
class Continued:
    """Samples, of shape (M, 3), and unit normals of the surfaces that were continued, and across how many holes."""

    points: Float
    normals: Float
    holes: int

    def __len__(self) -> int:
        return len(self.points)

    @classmethod
    def none(cls) -> Continued:
        """Return no samples."""
        return cls(np.zeros((0, 3)), np.zeros((0, 3)), 0)

    def joined(self, points: Float, normals: Float) -> tuple[Float, Float]:
        """Return points and normals, of shape (N, 3), and after them the samples, of shape (N + M, 3)."""
        return np.concatenate([points, self.points]), np.concatenate([normals, self.normals])


def continued(points: Float, normals: Float, exact: bool = True) -> Continued:
    """Return samples of the planes and cylinders that go on across the holes of a scan.

    Parameters
    ----------
    points, normals : arrays of shape (N, 3), unit coordinates, outward unit normals
    exact : whether normals may be believed where points are few; estimated ones may not
    """
    # By chance of its own, so that what follows draws the same whether there are holes or not.
    rng = np.random.default_rng(0)
    across = Continued.none()
    for _ in range(PASSES):
        more = _once(*across.joined(points, normals), exact, rng)
        enough = len(more) <= FEW * len(across)
        across = Continued(*across.joined(more.points, more.normals), max(across.holes, more.holes))
        if enough:
            break
    return across


def _once(points: Float, normals: Float, exact: bool, rng: np.random.Generator) -> Continued:
    """Return the same of one pass."""
    if len(points) < FEWEST:
        return Continued.none()
    drawn = rng.permutation(len(points))
    rows, closer = np.sort(drawn[:MOST_POINTS]), np.sort(drawn[:CLOSER])
    scan = _Scan.of(points[rows], normals[rows], points[closer], normals[closer], exact, rng)
    spacing = SPACING * scan.density.radius * np.sqrt(len(rows) / len(points))
    holes = scan.holes()
    if not holes or not scan.made(rng):
        return Continued.none()
    found = [some for places in holes if len((some := scan.across(places, spacing, rng))[0])]
    if not found:
        return Continued.none()
    samples, theirs = (np.concatenate(arrays) for arrays in zip(*found, strict=True))
    kept = ~mouths(samples, theirs, points, normals)
    return Continued(samples[kept], theirs[kept], len(found))


@dataclass(frozen=True)
class _Scan:
    """Oriented points, of shape (N, 3), as they tell of holes, and more that tell of surfaces, of shape (K, 3)."""

    points: Float
    normals: Float
    closer: Float
    their_normals: Float
    density: Density
    coarse: CoarseDistance
    exact: bool

    @cached_property
    def roughness(self) -> float:
        """Noise of the positions of those that tell of surfaces, in radii of their disks."""
        return Faces(self.closer, self.their_normals).roughness

    @classmethod
    def of(
        cls,
        points: Float,
        normals: Float,
        closer: Float,
        their_normals: Float,
        exact: bool,
        rng: np.random.Generator,
    ) -> _Scan:
        density = Density(points)
        coarse = CoarseDistance(points, normals, rng, density)
        return cls(points, normals, closer, their_normals, density, coarse, exact)

    def made(self, rng: np.random.Generator) -> bool:
        """Return whether the shape is one of planes at large, and not of a few that a grown one has by chance."""
        radius = self.density.radius
        return planar_share(self.points, self.normals, radius, self._off(radius), rng) > MADE

    def _off(self, radius: float) -> float:
        """Return how far off a surface its points lie at most, as disks of a radius tell."""
        return radius * float(np.clip(NOISE * self.roughness, *OFF))

    def holes(self) -> list[Float]:
        """Return places within each hole, of shape (K, 3), the largest hole first."""
        box = Box.around(self.points, MARGIN)
        # Where most points crowd, their disks would ask for a lattice without end.
        least = float(np.prod(box.upper - box.lower) / MOST_CELLS) ** (1 / 3)
        lattice = _lattice(box.lower, box.upper, max(STEP * self.density.radius, least))
        places = lattice.reshape(-1, 3)
        known, _, _ = self.coarse.size(places, FAR)
        doubtful = np.zeros(len(places), dtype=bool)
        doubtful[known] = np.abs(self.coarse.winding_number(places[known]) - 0.5) < DOUBTFUL
        number, count = ndimage.label(doubtful.reshape(lattice.shape[:3]), structure=np.ones((3, 3, 3)))
        found = [lattice[number == one] for one in range(1, count + 1)]
        found = [some for some in found if len(some) >= LEAST_CELLS and np.ptp(some, axis=0).max() <= WIDEST]
        return sorted(found, key=len, reverse=True)[:MOST_HOLES]

    def across(self, places: Float, spacing: float, rng: np.random.Generator) -> tuple[Float, Float]:
        """Return samples and normals, both of shape (M, 3), of the surfaces that go on across a hole."""
        radius, hole = self.density.radius, cKDTree(places)
        distance = hole.query(self.closer)[0] / radius
        around = distance < AROUND
        disk = radius * float(np.sqrt(len(self.points) / len(self.closer)))
        asked = distance[around] < TOUCH
        faces = self._surfaces(around, asked, disk, rng)
        faces = [face for face in faces if (hole.query(face.points)[0] < TOUCH * radius).sum() >= TOUCHING]
        if not faces:
            return np.zeros((0, 3)), np.zeros((0, 3))
        lower, upper = places.min(axis=0) - ROOM * radius, places.max(axis=0) + ROOM * radius
        size = max(float((upper - lower).max()) / CELLS, FINEST * radius)
        lattice = _lattice(lower, upper, size)
        cells = lattice.reshape(-1, 3)
        signed = np.stack([face.surface.at(cells) for face in faces], axis=1)
        believed = np.stack([_reached(face, cells, radius) for face in faces], axis=1)
        shape = lattice.shape[:3]
        known = self._known(cells, shape).reshape(shape)
        inside = minimal_inside(known, signed.reshape(*shape, -1), believed.reshape(*shape, -1))
        if _shut_away(inside, known < 0) or _shut_away(~inside, known > 0):
            return np.zeros((0, 3)), np.zeros((0, 3))
        samples, normals = _along(inside, lattice, size, signed, believed, [face.surface for face in faces], spacing)
        far = self.density.tree.query(samples)[0] > UNSEEN * radius
        far &= hole.query(samples)[0] < ROOM * radius
        return samples[far], normals[far]

    def _surfaces(self, around: Mask, asked: Mask, disk: float, rng: np.random.Generator) -> list[Seen]:
        """Return the surfaces of some points, and then those of what is left that have fewer points than others.

        Parameters
        ----------
        around : mask of shape (K,), of the points
        asked : mask of shape (around,), of those that propose
        disk : radius of what a point stands for
        rng : draws proposals
        """
        points, normals, off = self.closer[around], self.their_normals[around], self._off(disk)
        faces = surfaces(points, normals, asked, disk, off, rng)
        if not self.exact:
            return faces
        left = np.ones(len(points), dtype=bool)
        for face in faces:
            left &= ~agreed(face.surface, points, normals, off)
        # A face that was seen from the side.
        rest = points[left], normals[left], asked[left]
        return faces + surfaces(*rest, disk, off, rng.spawn(1)[0], Wanted(sparse=True))

    def _known(self, cells: Float, shape: tuple[int, ...]) -> Int:
        """Return 1 for cells, of shape (Q, 3), that are inside beyond doubt, -1 for those outside, and 0 elsewhere."""
        radius = self.density.radius
        distance, near = self.density.tree.query(cells, list(range(1, SIDES + 1)))
        height = np.einsum("qkd,qkd->qk", cells[:, None] - self.points[near], self.normals[near])
        sided = np.abs(np.sign(height).sum(axis=1)) == SIDES
        beside = (distance[:, 0] < BESIDE * radius) & sided & (np.abs(height).min(axis=1) > CLEAR * radius)
        winding = self.coarse.winding_number(cells)
        sure = (distance[:, 0] >= BESIDE * radius) & (np.abs(winding - 0.5) > 0.5 - CERTAIN)
        border = np.ones(shape, dtype=bool)
        border[1:-1, 1:-1, 1:-1] = False
        side = np.where(winding > 0.5, 1, -1)
        known: Int = np.where(beside, -np.sign(height[:, 0]), np.where(sure | border.ravel(), side, 0)).astype(int)
        return known


def _shut_away(sides: Mask, known: Mask) -> bool:
    """Return whether cells known to be off `sides` are shut away by these, as they cannot be from a scanner.

    Parameters
    ----------
    sides, known : masks of shape (a, b, c)
    """
    number, _ = ndimage.label(~sides)
    border = np.ones(sides.shape, dtype=bool)
    border[1:-1, 1:-1, 1:-1] = False
    held = np.bincount(number[known & ~sides])
    held[np.unique(number[border & ~sides])] = 0
    return bool(held[1:].max(initial=0) >= SHUT)


def _reached(face: Seen, cells: Float, radius: float) -> Mask:
    """Return the cells, of shape (Q, 3), that are no farther from where a surface was seen than it is believed in."""
    spread = np.sqrt(np.linalg.eigvalsh(np.cov(face.points.T))[1].clip(0.0))
    reach = max(REACH * WIDTH * float(spread), FAR * radius)
    reached: Mask = cKDTree(face.points).query(cells)[0] < reach
    return reached


def _along(
    inside: Mask,
    lattice: Float,
    size: float,
    signed: Float,
    believed: Mask,
    faces: list[Surface],
    spacing: float,
) -> tuple[Float, Float]:
    """Return samples, and normals, of surfaces where a cut runs along them.

    Parameters
    ----------
    inside : mask of shape (a, b, c), the cut
    lattice : array of shape (a, b, c, 3), the cells' centres, `size` apart
    signed, believed : arrays of shape (Q, faces), as of `minimal_inside`
    faces : the surfaces
    spacing : how far apart the samples are
    """
    cells, inner_cells = lattice.reshape(-1, 3), inside.ravel()
    numbers = np.arange(len(cells)).reshape(inside.shape)
    start, end, spread = [], [], []
    share = min(max(1, round(size / spacing)), MOST_ALONG)
    fine = (np.arange(share) + 0.5) / share - 0.5
    for axis in range(3):
        one, other = shifted(numbers, tuple(int(axis == k) for k in range(3)))
        across = np.zeros((share, share, 3))
        across[..., (axis + 1) % 3], across[..., (axis + 2) % 3] = size * fine[:, None], size * fine[None]
        for inner, outer in ((one, other), (other, one)):
            cut = inner_cells[inner] & ~inner_cells[outer]
            start.append(inner[cut])
            end.append(outer[cut])
            spread.append(np.repeat(across.reshape(1, -1, 3), int(cut.sum()), axis=0))
    inner, outer, beside = np.concatenate(start), np.concatenate(end), np.concatenate(spread)
    points, normals = [], []
    for number, face in enumerate(faces):
        on = (signed[inner, number] < 0) & (signed[outer, number] >= 0) & believed[inner, number]
        some = ((cells[inner[on]] + cells[outer[on]])[:, None] / 2 + beside[on]).reshape(-1, 3)
        some = feet(face, some)
        turned = face.normal(some)
        # Beyond an edge the cut goes on along another face: there both sides of this one are outside, or both inside.
        below, above = (_sides(inside, lattice, size, some + by * size * turned) for by in (-1, 1))
        some, turned = some[below & ~above], turned[below & ~above]
        _, first = np.unique(np.floor(some / spacing), axis=0, return_index=True)
        points.append(some[first])
        normals.append(turned[first])
    return np.concatenate(points), np.concatenate(normals)


def _sides(inside: Mask, lattice: Float, size: float, x: Float) -> Mask:
    """Return whether the cells nearest to x, of shape (Q, 3), are inside."""
    at = np.rint((x - lattice[0, 0, 0]) / size).astype(int).clip(0, np.array(inside.shape) - 1)
    sides: Mask = inside[at[:, 0], at[:, 1], at[:, 2]]
    return sides


def _lattice(lower: Float, upper: Float, size: float) -> Float:
    """Return the points of a lattice of cells of a size that covers a box, of shape (a, b, c, 3)."""
    axes = [np.arange(low, high + size, size) for low, high in zip(lower, upper, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


WITHIN = 1.5
"""How far points are looked for around a sample, in distances of the nearest one."""

ACROSS = 0.5
"""Most cosine of a wall's normal and the face's."""

OPEN = np.radians(150.0)
"""Widest angle about a sample into which no wall may be, of a mouth."""

MOUTH = 1.6
"""How far from such a sample others of the same face lie in the mouth, too, in distances of the nearest point."""

ALIKE = 0.95
"""Least cosine of the normals of samples of one face."""


# Samples of a face that was continued across the mouth of a bore, by what was seen of the bore's wall.
#
# A face that ends at a bore has a hole there, which looks like a part of the face that nobody saw. But points just
# behind the face, on the bore's wall, look to the middle of the hole from all around it, where the thing would be solid
# if the face went on.


def mouths(samples: Float, normals: Float, points: Float, their_normals: Float) -> Mask:
    """Return which samples lie in the mouths of bores, of shape (M,).

    Parameters
    ----------
    samples, normals : arrays of shape (M, 3), of faces that were continued
    points, their_normals : arrays of shape (N, 3), of the scan
    """
    found = np.zeros(len(samples), dtype=bool)
    if not len(samples):
        return found
    tree, others = cKDTree(points), cKDTree(samples)
    away = tree.query(samples)[0]
    for row, near in enumerate(tree.query_ball_point(samples, WITHIN * away)):
        if not found[row] and _walled(points[near] - samples[row], their_normals[near], normals[row]):
            same = np.array(others.query_ball_point(samples[row], MOUTH * away[row]))
            found[same[normals[same] @ normals[row] > ALIKE]] = True
    return found


def _walled(places: Float, normals: Float, axis: Float) -> bool:
    """Return whether walls, behind the origin along an axis, look to it from all around it."""
    wall = (np.abs(normals @ axis) < ACROSS) & (places @ axis < 0) & (np.einsum("nd,nd->n", normals, places) < 0)
    return bool(widest_gap(places[wall], axis) < OPEN)
