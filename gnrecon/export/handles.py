"""Drop handles and tunnels that no point supports.

Where points are sparse or noisy, beside an edge or between two walls, a field may cross zero often, and its surface
hangs together by necks and is pierced by tunnels that no scan could have told. A loop around such a neck or through
such a tunnel does not take the surface apart, and is short beside the disks that points stand for. A real tunnel has
points on its wall, and a real rod on its sides: the normals of the surface at the points near its loop go all around
it. So a loop is dropped where these leave more than half of the circle bare and it is no longer than the rim of one
disk, or five sixths and it is twice as long. It may be three times as long where it runs around a neck and no point is
near at all; the wall of a tunnel may be out of sight of a scanner that saw its mouths. The surface is cut along the
loop, and both rims are closed by a cap: a neck is cut through, a tunnel closed at both ends, and the genus is one less.
Then the caps, what lies right beside them, and what is left of a neck are laid out smoothly; what points support stays.
Sources: Guskov and Wood, Topological noise removal (2001); Kobbelt, Campagna, Vorsatz and Seidel, Interactive
multi-resolution modeling on arbitrary meshes (1998), for the layout.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
from scipy.sparse import csr_array, diags_array, eye_array
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from gnrecon.export.cycles import Loop, short_loops
from gnrecon.export.mesh_statistics import Edges, corner_fans
from gnrecon.export.verify import require_sound
from gnrecon.geometry.arrays import Float, Int, Mask
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.statistics import widest_gap
from gnrecon.runtime.errors import MeshError

RIM = 2 * np.pi
"""Length of a disk's rim, in radii of it."""

BARE = (1.0, np.pi), (2.0, 5 / 3 * np.pi)
"""Lengths of loops that are dropped, at most, in rims, and how much of the circle their points must leave bare."""

UNSEEN = 3.0
"""Length of a loop around a neck that no point is near, at most, in rims."""

NEAR, UPON = 2.0, 0.7
"""How near to a place and to the surface points lie that tell of it, in disks."""

ASIDE, ALIKE = 0.7, 0.5
"""Cosines: at most of a loop's axis and a normal that tells of it, at least of the normals of a place and a point."""

AROUND = 8
"""Points that a vertex is compared with, and that a point's plane goes through beside itself."""

STUB, BESIDE = 3.0, 0.3
"""How far from a cap the surface is laid out anew where no points support it, and anywhere, in lengths of the loop."""

ROUNDS, TOGETHER = 20, 24
"""Times that loops are looked for, and loops that are cut at once: few enough for their words of 64 bits."""


def remove_handles(mesh: Mesh, points: Float) -> tuple[Mesh, list[str]]:
    """Cut handles and close tunnels that no points support.

    Parameters
    ----------
    mesh : Mesh
        A closed, oriented 2-manifold.
    points : array of shape (N, 3), units of the mesh
        The cloud that the surface was fitted to.

    Returns
    -------
    Mesh
        The same mesh where there is none; a closed, oriented 2-manifold of as many components.
    list of str
        A sentence for what was done.

    Raises
    ------
    MeshError
        When the mesh is not sound, as an open one.
    """
    require_sound(mesh)
    if len(points) < 2:
        return mesh, []
    support, rng = _PointSupport(points), np.random.default_rng(0)
    mesh, lengths = _cut_uncovered_loops(mesh, support, rng)
    mesh, more = _cut_unsupported_necks(mesh, support, rng)
    lengths += more
    if not lengths:
        return mesh, []
    handles = "a handle or tunnel" if len(lengths) == 1 else f"{len(lengths)} handles or tunnels"
    return mesh, [f"Removed {handles} that no points support, of up to {max(lengths):.3g} around."]


def _cut_uncovered_loops(mesh: Mesh, support: _PointSupport, rng: np.random.Generator) -> tuple[Mesh, list[float]]:
    """Cut along short loops whose points leave more bare than they may, and return the loops' lengths, too."""
    lengths: list[float] = []
    disks, sought = support.disks(mesh), np.ones(len(mesh.vertices), dtype=bool)
    for _ in range(ROUNDS):
        uncovered = support.uncovered(mesh, disks, short_loops(mesh, BARE[-1][0] * RIM * disks, sought, rng))
        loops = _independent(mesh, uncovered)
        cut = _cut_and_cap(mesh, loops, support)
        if cut is None:
            break
        lengths += [loop.length for loop in loops]
        # Those that are left lie near some that were found, which hid them or lay too near to be cut at once.
        places = cKDTree(np.concatenate([mesh.vertices[loop.vertices] for loop in uncovered]))
        mesh, disks = cut, support.disks(cut)
        sought = places.query(mesh.vertices)[0] <= RIM * disks
    return mesh, lengths


def _cut_unsupported_necks(mesh: Mesh, support: _PointSupport, rng: np.random.Generator) -> tuple[Mesh, list[float]]:
    """Cut along longer loops around necks that no point is near, and return the loops' lengths, too."""
    lengths: list[float] = []
    for _ in range(ROUNDS):
        away, disks = support.nearest(mesh)
        unseen = away > NEAR * disks
        if not unseen.any():
            break
        found = short_loops(mesh, UNSEEN * RIM * disks, unseen, rng)
        normals = mesh.vertex_normals()
        loops = _independent(
            mesh, [loop for loop in found if unseen[loop.vertices].all() and _is_neck(mesh, normals, loop)]
        )
        cut = _cut_and_cap(mesh, loops, support)
        if cut is None:
            break
        lengths += [loop.length for loop in loops]
        mesh = cut
    return mesh, lengths


class _PointSupport:
    """What points tell of a surface.

    Parameters
    ----------
    points : of shape (N, 3)
    """

    def __init__(self, points: Float) -> None:
        # It brings torch, which a check of a mesh does without.
        from gnrecon.geometry.signed_distance import Density

        self._density = Density(points)

    def disks(self, mesh: Mesh) -> Float:
        """Return the radius of the disk of the point nearest to each vertex, of shape (V,)."""
        return self.nearest(mesh)[1]

    def nearest(self, mesh: Mesh) -> tuple[Float, Float]:
        """Return the distance from each vertex to the nearest point, and the radius of its disk, both of shape (V,)."""
        away, near = self._density.tree.query(mesh.vertices)
        return np.asarray(away), np.asarray(self._density.disks[near])

    def unsupported(self, mesh: Mesh) -> Mask:
        """Return which vertices, of shape (V,), have no point near on a surface that looks as theirs does."""
        vertex, upon = self._on_surface(mesh)
        away, near = self._density.tree.query(mesh.vertices, k=min(AROUND, len(vertex)))
        looks = np.abs(np.einsum("vi,vki->vk", mesh.vertex_normals(), self._normals[near]))
        held = (away < NEAR * self._density.disks[near]) & upon[near] & (looks > ALIKE)
        return np.asarray(~held.any(axis=1))

    @cached_property
    def _normals(self) -> Float:
        """Normals of either sign of the planes of each point and those around it, of shape (N, 3).

        The surface's own would not do: a point in the mouth of a tunnel lies nearest to the tunnel's wall.
        """
        points = self._density.points
        around = points[self._density.tree.query(points, k=min(AROUND + 1, len(points)))[1]]
        spread = around - around.mean(axis=1, keepdims=True)
        return np.asarray(np.linalg.eigh(np.einsum("nki,nkj->nij", spread, spread))[1][:, :, 0])

    def uncovered(self, mesh: Mesh, disks: Float, loops: Sequence[Loop]) -> list[Loop]:
        """Return the loops that are short, and whose points leave more bare than they may."""
        if not loops:
            return []
        vertex, upon = self._on_surface(mesh)
        places, normals = cKDTree(mesh.vertices[vertex[upon]]), mesh.vertex_normals()[vertex[upon]]
        kept = []
        for loop in loops:
            disk = float(disks[loop.vertices].mean())
            limit = next((uncovered for length, uncovered in BARE if loop.length <= length * RIM * disk), None)
            if limit is not None:
                near = np.unique(np.concatenate(places.query_ball_point(mesh.vertices[loop.vertices], NEAR * disk)))
                if _uncovered_angle(mesh.vertices[loop.vertices], normals[near.astype(np.int64)]) > limit:
                    kept.append(loop)
        return kept

    def _on_surface(self, mesh: Mesh) -> tuple[Int, Mask]:
        """Return the vertex nearest to each point, and which points lie on the surface; both of shape (N,)."""
        away, vertex = cKDTree(mesh.vertices).query(self._density.points)
        return vertex, away < UPON * self._density.disks


def _is_neck(mesh: Mesh, normals: Float, loop: Loop) -> bool:
    """Return whether a loop runs around what is inside: the vertices' normals, of shape (V, 3), look away from it."""
    ring = mesh.vertices[loop.vertices]
    return float(((ring - ring.mean(axis=0)) * normals[loop.vertices]).sum()) > 0


def _uncovered_angle(ring: Float, normals: Float) -> float:
    """Return the largest angle about a ring's axis into which no normal looks, of shapes (L, 3) and (N, 3)."""
    arms = ring - ring.mean(axis=0)
    axis = np.cross(arms, np.roll(arms, -1, axis=0)).sum(axis=0)
    size = float(np.linalg.norm(axis))
    if size == 0:
        return 2 * np.pi
    axis /= size
    return widest_gap(normals[np.abs(normals @ axis) < ASIDE], axis)


def _independent(mesh: Mesh, loops: Sequence[Loop]) -> list[Loop]:
    """Return the shortest loops that have no neighbours in common and together do not take the surface apart."""
    start, end = mesh.faces.reshape(-1), np.roll(mesh.faces, -1, axis=1).reshape(-1)
    table = csr_array((np.ones(len(start), dtype=bool), (start, end)), shape=(len(mesh.vertices),) * 2)
    used = np.zeros(len(mesh.vertices), dtype=bool)
    basis: list[int] = []
    kept = []
    for loop in loops:
        signature = loop.signature
        for one in basis:
            signature = min(signature, signature ^ one)
        around = np.append(loop.vertices, table[loop.vertices].indices)
        if signature == 0 or used[around].any():
            continue
        used[around] = True
        basis = sorted([*basis, signature], reverse=True)
        kept.append(loop)
        if len(kept) == TOGETHER:
            break
    return kept


def _cut_and_cap(mesh: Mesh, loops: Sequence[Loop], support: _PointSupport) -> Mesh | None:
    """Return the mesh cut along loops and closed again, or None where there are none, or it would not be sound."""
    if not loops:
        return None
    closed, reach = _cap_loops(mesh, loops)
    smooth = _fair(closed, reach, support.unsupported(closed))
    try:
        require_sound(smooth)
    except MeshError:
        return None
    return smooth


def _cap_loops(mesh: Mesh, loops: Sequence[Loop]) -> tuple[Mesh, Float]:
    """Return the mesh cut along loops and closed by fans, and the length of the loop of each fan, of shape (C,).

    The fans' middles are the last vertices.
    """
    edges = Edges.of(mesh)
    ends = edges.ends[edges.first]
    size = len(mesh.vertices)
    rings = [loop.vertices for loop in loops]
    pairs = np.sort(np.concatenate([np.stack([ring, np.roll(ring, -1)], axis=1) for ring in rings]), axis=1)
    cut = np.isin(ends[:, 0] * size + ends[:, 1], pairs[:, 0] * size + pairs[:, 1])
    # What meets across an edge of a loop belongs to two fans from now on.
    fans = corner_fans(mesh, replace(edges, count=np.where(cut, 1, edges.count)))
    _, first, corners = np.unique(fans, return_index=True, return_inverse=True)
    origin, faces = mesh.faces.reshape(-1)[first], corners.reshape(-1, 3)
    vertices = mesh.vertices[origin]
    opened = Edges.of(Mesh(vertices, faces))
    half = opened.corner[opened.first[opened.count == 1]]
    begin, end = faces.reshape(-1)[half], faces[half // 3, (half % 3 + 1) % 3]
    links = csr_array((np.ones(len(half), dtype=bool), (begin, end)), shape=(len(vertices),) * 2)
    _, cap = np.unique(connected_components(links, directed=False)[1][begin], return_inverse=True)
    middles = np.stack([np.bincount(cap, column) for column in vertices[begin].T], axis=1) / np.bincount(cap)[:, None]
    length = np.zeros(size)
    for loop in loops:
        length[loop.vertices] = loop.length
    reach = np.zeros(len(middles))
    reach[cap] = length[origin[begin]]
    faces = np.concatenate([faces, np.column_stack([end, begin, len(vertices) + cap])])
    # A middle takes what is known of a vertex on its rim.
    origin = np.append(origin, origin[begin[np.unique(cap, return_index=True)[1]]])
    attributes = {name: values[origin] for name, values in mesh.attributes.items()}
    normals = None if mesh.normals is None else mesh.normals[origin]
    return Mesh(np.concatenate([vertices, middles]), faces, normals, attributes), reach


def _fair(mesh: Mesh, reach: Float, unsupported: Mask) -> Mesh:
    """Return a mesh whose caps, and what lies around them, lie smoothly.

    Of all layouts that keep the other vertices it has the least sum of squares of each vertex's offset from the mean of
    its neighbours.

    Parameters
    ----------
    mesh : whose last vertices are the middles of caps
    reach : of shape (C,), length of each cap's loop
    lonely : of shape (V,), which vertices no points support, as what is left of a neck
    """
    size = len(mesh.vertices)
    start, end = mesh.faces.reshape(-1), np.roll(mesh.faces, -1, axis=1).reshape(-1)
    away = np.linalg.norm(mesh.vertices[start] - mesh.vertices[end], axis=1)
    caps = np.arange(size - len(reach), size)
    loose = unsupported.copy()
    loose[mesh.faces[(mesh.faces >= caps[0]).any(axis=1)]] = True
    along = loose[start] & loose[end]
    paths = csr_array((away, (start, end)), shape=(size, size))
    stubs = csr_array((away[along], (start[along], end[along])), shape=(size, size))
    free = np.zeros(size, dtype=bool)
    for cap, length in zip(caps, reach, strict=True):
        free |= np.isfinite(dijkstra(stubs, indices=cap, limit=STUB * length))
        free |= np.isfinite(dijkstra(paths, indices=cap, limit=BESIDE * length))
    means = csr_array((np.ones(len(start)), (start, end)), shape=(size, size))
    offsets = diags_array(1.0 / means.sum(axis=1)) @ means - eye_array(size)
    rows = np.flatnonzero(abs(offsets) @ free)
    inner, outer = offsets[rows][:, np.flatnonzero(free)], offsets[rows][:, np.flatnonzero(~free)]
    # Far-off coordinates would cancel badly.
    middle = mesh.vertices[free].mean(axis=0)
    vertices = mesh.vertices.copy()
    vertices[free] = middle - splu((inner.T @ inner).tocsc()).solve(inner.T @ (outer @ (vertices[~free] - middle)))
    smooth = mesh.with_vertices(vertices)
    if mesh.normals is None:
        return smooth
    by_faces = Mesh(vertices, mesh.faces).vertex_normals()
    return replace(smooth, normals=np.where(free[:, None], by_faces, mesh.normals))
