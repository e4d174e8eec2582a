"""Drops components of a mesh that no scanned point supports, and finds those that a fit has cut off by a hair.

Where a fitted field has no data it may cross zero by chance: ghost sheets in free space, and cavities within the solid.
Each input point votes for the component that its nearest face belongs to, and components with few votes are dropped. Of
what remains, components within an even number of others are made outer shells (positive volume), those within an odd
number cavities (negative volume), because dropping a shell may change which of the two a component is.

Where a part is thinner than its points are apart, or than their noise, the field may cross zero on both sides of a
place between two points of the same part: the tip of a horn, or a leg below the knee, is a component of its own.
Between two surfaces that are apart a distance rises with a slope of one from both, and a smooth function that does has
a quarter of the gap in its middle. Where the field reaches less than half of that, it does not say that there is a gap,
and the two are one part: they vote together, and `bridge` joins them. A component of outliers may lie so near by
chance; so one needs more points than any stray component has that the field does show a gap to.

The entries are `remove_stray`, `supported_components` and `drop_stray_components`, and `bridge`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from gnrecon.export.boolean import unite
from gnrecon.export.export_parameters import ExportParameters
from gnrecon.export.mesh_statistics import concatenated, face_components, submesh
from gnrecon.export.metrics import nearest_on_surface
from gnrecon.export.project import SignedDistance, side_lengths
from gnrecon.export.verify import require_sound
from gnrecon.geometry.arrays import Float, Int, Mask
from gnrecon.geometry.mesh import Mesh
from gnrecon.runtime.errors import MeshError, UsageError
from gnrecon.runtime.quiet_imports import import_uninterrupted


def remove_stray(mesh: Mesh, points: Float) -> tuple[Mesh, list[str]]:
    """Drop components that too few points lie nearest to.

    A component stays when it is nearest to at least ``max(3, 0.5 % of the points)`` points, or to more than any other.

    Parameters
    ----------
    mesh : Mesh
        Closed, in file units.
    points : array of shape (N, 3), file units
        The cloud that was fitted.

    Returns
    -------
    Mesh
        The same mesh where nothing was dropped.
    list of str
        A sentence with counts for each change.

    Raises
    ------
    UsageError
        When there are no points.
    """
    mesh, actions, _ = supported_components(mesh, points)
    return mesh, actions


class Supported(NamedTuple):
    """The components of a mesh that stay.

    Parameters
    ----------
    mesh : Mesh
        The same mesh where nothing was dropped.
    actions : list of str
        A sentence with counts for each change.
    gaps : array of shape (B, 2, 3), file units
        The two ends of each gap that the field does not show; see `bridge`.
    """

    mesh: Mesh
    actions: list[str]
    gaps: Float


def supported_components(mesh: Mesh, points: Float | None, field: SignedDistance | None = None) -> Supported:
    """Drop the same components, but let those vote together between which the field shows no gap.

    Parameters and errors are those of `remove_stray`; without a field, each component votes for itself, and with None
    for the points all stay.
    """
    if points is None:
        return Supported(mesh, [], np.empty((0, 2, 3)))
    labels, votes, least = _vote(mesh, points)

    @cache
    def part(label: int) -> Mesh:
        return submesh(mesh, labels == label)

    alone = np.arange(len(votes))
    groups, gaps = (alone, []) if field is None else _grouped(part, votes, least, field)
    stays, actions = _enough(labels, votes, least, groups, len(points))
    ends = np.array([ends for label, ends in gaps if stays[label]]).reshape(-1, 2, 3)
    if stays.all():
        return Supported(mesh, [], ends)
    parts = [part(int(label)) for label in np.flatnonzero(stays)]
    oriented = [_orient_component(part, [other for other in parts if other is not part]) for part in parts]
    turned = sum(new is not old for new, old in zip(oriented, parts, strict=True))
    if turned:
        actions.append(f"Reversed {turned} components, because the shell around them was dropped.")
    return Supported(concatenated(oriented), actions, ends)


def drop_stray_components(mesh: Mesh, points: Float) -> tuple[Mesh, list[str]]:
    """Drop the same components of a mesh that may have borders; the others keep their orientation.

    Parameters, return values and errors are those of `remove_stray`.
    """
    labels, votes, least = _vote(mesh, points)
    stays, actions = _enough(labels, votes, least, np.arange(len(votes)), len(points))
    return (mesh, []) if stays.all() else (submesh(mesh, stays[labels]), actions)


def _vote(
    mesh: Mesh,
    points: Float,
    *,
    least_points: int = ExportParameters.repair.stray_points,
    least_share: float = ExportParameters.repair.stray_point_share,
) -> tuple[Int, Int, float]:
    """Return each face's component, the votes for each component, and how many it needs."""
    if not len(points):
        raise UsageError("There are no points, so stray components cannot be found.")
    labels = face_components(mesh)
    count = int(labels.max(initial=-1)) + 1
    nearest = np.zeros(len(points), dtype=np.int64) if count < 2 else _nearest_components(mesh, labels, points)
    return labels, np.bincount(nearest, minlength=count)[:count], max(least_points, least_share * len(points))


def _enough(labels: Int, votes: Int, least: float, groups: Int, points: int) -> tuple[Mask, list[str]]:
    """Return which components stay, and a sentence about the others.

    Those of one group, of the groups of shape (C,), vote together, and the group with the most votes always stays.
    """
    together = np.bincount(groups, votes, minlength=len(votes))
    stays = np.asarray((together >= least)[groups])
    if len(votes):
        stays |= groups == together.argmax()
    dropped, faces = np.count_nonzero(~stays), np.count_nonzero(~stays[labels])
    sentence = (
        f"Dropped {dropped} of {len(votes)} components, with {faces} of {len(labels)} faces: "
        f"fewer than {least:g} of the {points} points lie nearest to each (at most {votes[~stays].max(initial=0)})."
    )
    return stays, [sentence] if dropped else []


@dataclass(frozen=True)
class _Gap:
    """The shortest way between two components: their places in a list, and both ends, of shape (2, 3)."""

    one: int
    other: int
    ends: Float

    @property
    def length(self) -> float:
        return float(np.linalg.norm(self.ends[1] - self.ends[0]))

    def is_shown(self, field: SignedDistance, *, samples: int = 15, least_rise: float = 0.5) -> bool:
        """Return whether a field rises along the gap by this share of what a smooth distance would."""
        shares = np.linspace(0, 1, samples + 2)[1:-1, None]
        rise = float(field.sdf(self.ends[0] + shares * (self.ends[1] - self.ends[0])).max())
        return rise > least_rise * self.length / 4


def _grouped(
    part: Callable[[int], Mesh],
    votes: Int,
    least: float,
    field: SignedDistance,
    *,
    least_points: int = ExportParameters.repair.stray_points,
) -> tuple[Int, list[tuple[int, Float]]]:
    """Return the group of each component, of shape (C,), and the gaps within groups, which the field does not show.

    A gap is the label of a component and both ends, of shape (2, 3). Only solid components with some votes are asked
    for: what lies in free space, and cavities, stay alone. `part` returns the component of a label, and `least` is the
    number of votes that one needs.
    """
    groups, gaps = np.arange(len(votes)), list[tuple[int, Float]]()
    voted = [int(label) for label in np.flatnonzero(votes >= least_points)]
    if len(voted) < 2:
        return groups, gaps
    # Those of few points first: they are joined to the others.
    solid = np.array(sorted((one for one in voted if part(one).volume > 0), key=votes.__getitem__), dtype=np.int64)
    apart, places = _Gaps([part(int(label)) for label in solid]), np.arange(len(solid))
    few = [place for place in places[:-1] if votes[solid[place]] < least]
    stray = [place for place in few if apart.shortest([place], np.delete(places, place)).is_shown(field)]
    # Outliers may lie on a component by chance: one with no more points than one that is surely stray is no part.
    allowed = votes[solid] > max((votes[solid[place]] for place in stray), default=0)
    waiting = [place for place in places[:-1] if allowed[place]]
    while waiting:
        group = groups[solid[waiting.pop(0)]]
        inner = allowed & (groups[solid] == group)
        if inner[-1]:
            continue
        gap = apart.shortest(np.flatnonzero(inner), np.flatnonzero(allowed & ~inner))
        if gap.is_shown(field):
            continue
        gaps.append((int(solid[gap.one]), gap.ends))
        groups[groups == group] = groups[solid[gap.other]]
        # What was too far from others may be near with its new part.
        waiting.append(gap.other)
    return groups, gaps


class _Gaps:
    """The gaps between components of a mesh."""

    def __init__(self, parts: Sequence[Mesh]) -> None:
        self._parts = parts
        self._low = np.array([part.vertices.min(axis=0) for part in parts]).reshape(-1, 3)
        self._high = np.array([part.vertices.max(axis=0) for part in parts]).reshape(-1, 3)
        self._tree = cache(lambda place: cKDTree(parts[place].vertices))

    def shortest(self, inner: Iterable[int], outer: Int) -> _Gap:
        """Return the shortest gap between a component of places `inner` and one of `outer`, of which there are some."""
        best: _Gap | None = None
        for one in inner:
            # The boxes of two components are no farther apart than they are.
            outside = np.maximum(self._low[one] - self._high[outer], self._low[outer] - self._high[one])
            boxes = np.linalg.norm(np.maximum(outside, 0), axis=1)
            for place in np.argsort(boxes, kind="stable"):
                within = np.inf if best is None else best.length
                if boxes[place] >= within:
                    break
                best = self._between(int(one), int(outer[place]), within) or best
        if best is None:
            raise ValueError("There are no components.")
        return best

    def _between(self, one: int, other: int, within: float) -> _Gap | None:
        """Return the gap between two components where it is shorter than `within`."""
        few, many = sorted([one, other], key=lambda place: len(self._parts[place].vertices))
        vertices = self._parts[few].vertices
        away, row = self._tree(many).query(vertices, distance_upper_bound=within)
        nearest = int(away.argmin())
        if not np.isfinite(away[nearest]):
            return None
        return _Gap(one, other, np.stack([vertices[nearest], self._parts[many].vertices[row[nearest]]]))


def bridge(mesh: Mesh, gaps: Float, points: Float, *, least_sides: float = 2.0) -> tuple[Mesh, list[str]]:
    """Join components across gaps: the surface near both ends of a gap gets its convex hull.

    Parameters
    ----------
    mesh : Mesh
        Sound, in file units.
    gaps : array of shape (B, 2, 3), file units
        As `supported_components` finds them.
    points : array of shape (N, 3), file units
        The cloud that was fitted. Near an end is what lies within the radius of the disk that a point stands for there.
    least_sides : float
        The least radius, in mean sides of faces.

    Returns
    -------
    Mesh
        The same mesh where there are no gaps, or what would come of it is not sound.
    list of str
        A sentence on what was joined.
    """
    if not len(gaps):
        return mesh, []
    # It imports torch, which repairing a mesh does not need.
    from gnrecon.geometry.signed_distance import Density

    density, tree = Density(points), cKDTree(mesh.vertices)
    disks = density.disks[density.tree.query(gaps)[1]].max(axis=1)
    reach = np.maximum(disks, least_sides * float(side_lengths(mesh).mean()))
    near = [
        np.concatenate(tree.query_ball_point(ends, radius)).astype(np.int64)
        for ends, radius in zip(gaps, reach, strict=True)
    ]
    hulls = [np.concatenate([mesh.vertices[rows], ends]) for rows, ends in zip(near, gaps, strict=True)]
    try:
        joined = unite(mesh, hulls)
        require_sound(joined)
    except MeshError:
        return mesh, []
    longest = np.linalg.norm(gaps[:, 1] - gaps[:, 0], axis=1).max()
    count = "a component" if len(gaps) == 1 else f"{len(gaps)} components"
    return joined, [f"Joined {count} to the rest, across up to {longest:.3g} where the field shows no gap."]


def _nearest_components(mesh: Mesh, labels: Int, points: Float) -> Int:
    """Return the component, of shape (N,), that each point's nearest face, of labels of shape (F,), belongs to.

    Most points are so near to a vertex of the largest component that no other can be nearer; the others are few.
    """
    largest = int(np.bincount(labels).argmax())
    one, others = submesh(mesh, labels == largest), submesh(mesh, labels != largest)
    # No point of a triangle is farther from all of its corners than its longest side over the root of three.
    reach = float(side_lengths(others).max()) / np.sqrt(3)
    near, next_near = (cKDTree(part.vertices).query(points)[0] for part in (one, others))
    unclear = next_near - reach <= near
    nearest = np.full(len(points), largest, dtype=labels.dtype)
    if unclear.any():
        within = np.minimum(near, next_near)[unclear]
        nearest[unclear] = labels[_nearest_faces(mesh, points[unclear], within)]
    return nearest


def _nearest_faces(mesh: Mesh, points: Float, within: Float, *, most_pairs: int = 300_000) -> Int:
    """Return the nearest face of each point, of shape (N,), which is at most as far as `within`, of shape (N,).

    Few points are compared with the faces about them, as the library that finds the nearest of all is slow to load.
    """
    corners = mesh.vertices[mesh.faces]
    tree = cKDTree(corners.mean(axis=1))
    # A triangle's points are no farther from its centre than two thirds of its longest side, in single precision.
    radius = (1 + 1e-6) * (within + float(side_lengths(mesh).max()) * 2 / 3)
    counts = tree.query_ball_point(points, radius, return_length=True)
    if counts.sum() > most_pairs:
        return nearest_on_surface(mesh, points)[1]
    closest_point = import_uninterrupted("trimesh").triangles.closest_point
    faces = np.concatenate(tree.query_ball_point(points, radius)).astype(np.int64)
    repeated = np.repeat(points, counts, axis=0)
    distance = np.linalg.norm(closest_point(corners[faces], repeated) - repeated, axis=1)
    starts = np.cumsum(counts) - counts
    order = np.lexsort([distance, np.repeat(np.arange(len(points)), counts)])
    nearest: Int = faces[order[starts]]
    return nearest


def _orient_component(part: Mesh, others: list[Mesh]) -> Mesh:
    """Reverse a component where its volume's sign does not fit the number of others around it."""
    outer = sum(_encloses(other, part.vertices[0]) for other in others) % 2 == 0
    if (part.volume > 0) == outer:
        return part
    return Mesh(part.vertices, part.faces[:, ::-1], None if part.normals is None else -part.normals)


def _encloses(shell: Mesh, point: Float) -> bool:
    """Whether the winding number of a closed shell, of either orientation, about a point of shape (3,) is not zero."""
    if (point < shell.vertices.min(axis=0)).any() or (point > shell.vertices.max(axis=0)).any():
        return False
    a, b, c = np.moveaxis(shell.corners - point, 1, 0)
    la, lb, lc = (np.linalg.norm(side, axis=1) for side in (a, b, c))
    # Half the solid angle of a triangle, by van Oosterom and Strackee (1983).
    half = np.arctan2(
        np.einsum("ij,ij->i", a, np.cross(b, c)),
        la * lb * lc
        + np.einsum("ij,ij->i", a, b) * lc
        + np.einsum("ij,ij->i", b, c) * la
        + np.einsum("ij,ij->i", c, a) * lb,
    )
    return bool(abs(half.sum() / (2 * np.pi)) > 0.5)
