"""Removes handles and tunnels that no point supports: topological noise of a fitted field.

Where points are sparse or noisy, near an edge or between two walls, a field may cross zero often, and its surface is
joined by necks and pierced by tunnels that no scan showed. A loop around such a neck or through such a tunnel does not
separate the surface, and is short compared with the disks that the points represent. A real tunnel has points on its
wall, and a real rod on its sides: the normals of the surface at the points near its loop cover all directions around
it. So a loop is cut where these normals leave more than half of the circle uncovered and it is no longer than the rim
of one disk, or where they leave five sixths uncovered and it is at most twice as long. It may be three times as long
where it runs around a neck and no point is near; the wall of a tunnel may be hidden from a scanner that saw its ends.
The surface is cut along the loop, and both rims are closed by a cap: a neck is cut through, a tunnel closed at both
ends, and the genus drops by one. Then the caps, their surroundings and the rest of a neck are faired; surface that
points support stays. The entry is `remove_handles`.
Sources: Guskov and Wood, Topological noise removal (2001); Kobbelt, Campagna, Vorsatz and Seidel, Interactive
multi-resolution modeling on arbitrary meshes (1998), for the fairing.
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
from gnrecon.export.export_parameters import ExportParameters, HandleParameters
from gnrecon.export.mesh_statistics import Edges, corner_fans
from gnrecon.export.verify import require_sound
from gnrecon.geometry.arrays import Float, Int, Mask
from gnrecon.geometry.local_pca import plane_normals
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.statistics import widest_gap
from gnrecon.runtime.errors import MeshError


def remove_handles(
    mesh: Mesh, points: Float, *, parameters: HandleParameters | None = None, known_sound: bool = False
) -> tuple[Mesh, list[str]]:
    """Cut handles and close tunnels that no points support.

    Parameters
    ----------
    mesh : Mesh
        A closed, oriented 2-manifold.
    points : array of shape (N, 3), units of the mesh
        The cloud that the surface was fitted to.
    parameters : HandleParameters, optional
        By default ``HandleParameters()``.
    known_sound : bool
        Whether the mesh need not be checked, as after a repair.

    Returns
    -------
    Mesh
        The same mesh where there is none; a closed, oriented 2-manifold of as many components.
    list of str
        A sentence on what was removed.

    Raises
    ------
    MeshError
        When the mesh is not sound, as an open one.
    """
    if not known_sound:
        require_sound(mesh)
    if len(points) < 2:
        return mesh, []
    # The random words only tell classes apart, so that a fixed seed gives the same mesh each time.
    support, rng = _PointSupport(points, parameters or ExportParameters.handles), np.random.default_rng(0)
    mesh, lengths = _cut_uncovered_loops(mesh, support, rng)
    mesh, more = _cut_unsupported_necks(mesh, support, rng)
    lengths += more
    if not lengths:
        return mesh, []
    handles = "a handle or tunnel" if len(lengths) == 1 else f"{len(lengths)} handles or tunnels"
    return mesh, [f"Removed {handles} that no points support, up to {max(lengths):.3g} in circumference."]


def _cut_uncovered_loops(mesh: Mesh, support: _PointSupport, rng: np.random.Generator) -> tuple[Mesh, list[float]]:
    """Cut along short loops that are not covered by points, and return the loops' lengths, too."""
    lengths: list[float] = []
    longest_rims = support.parameters.loop_rims_and_free_angles[-1][0]
    disks, sought = support.disks(mesh), np.ones(len(mesh.vertices), dtype=bool)
    for _ in range(support.parameters.rounds):
        found = short_loops(mesh, longest_rims * (2 * np.pi) * disks, sought, rng)
        uncovered = support.uncovered(mesh, disks, found)
        loops = _independent(mesh, uncovered, support.parameters.loops_at_once)
        cut = _cut_and_cap(mesh, loops, support)
        if cut is None:
            break
        lengths += [loop.length for loop in loops]
        # Further loops are near some that were found, which hid them or were too near to be cut at once.
        places = cKDTree(np.concatenate([mesh.vertices[loop.vertices] for loop in uncovered]))
        mesh, disks = cut, support.disks(cut)
        sought = places.query(mesh.vertices)[0] <= 2 * np.pi * disks
    return mesh, lengths


def _cut_unsupported_necks(mesh: Mesh, support: _PointSupport, rng: np.random.Generator) -> tuple[Mesh, list[float]]:
    """Cut along longer loops around necks that no point is near, and return the loops' lengths, too."""
    lengths: list[float] = []
    for _ in range(support.parameters.rounds):
        away, disks = support.nearest(mesh)
        # Only vertices without a point near: these loops may be long, and would cut real rods otherwise.
        unseen = away > support.parameters.near_disks * disks
        if not unseen.any():
            break
        found = short_loops(mesh, support.parameters.neck_rims * (2 * np.pi) * disks, unseen, rng)
        normals = mesh.vertex_normals()
        necks = [loop for loop in found if unseen[loop.vertices].all() and _is_neck(mesh, normals, loop)]
        loops = _independent(mesh, necks, support.parameters.loops_at_once)
        cut = _cut_and_cap(mesh, loops, support)
        if cut is None:
            break
        lengths += [loop.length for loop in loops]
        mesh = cut
    return mesh, lengths


class _PointSupport:
    """The support of a surface by points.

    Parameters
    ----------
    points : of shape (N, 3)
    parameters : HandleParameters
    """

    def __init__(self, points: Float, parameters: HandleParameters) -> None:
        # It imports torch, which checking a mesh does not need.
        from gnrecon.geometry.signed_distance import Density

        self.parameters = parameters
        self._density = Density(points)

    def disks(self, mesh: Mesh) -> Float:
        """Return the radius of the disk of the point nearest to each vertex, of shape (V,)."""
        return self.nearest(mesh)[1]

    def nearest(self, mesh: Mesh) -> tuple[Float, Float]:
        """Return the distance from each vertex to the nearest point, and the radius of its disk, both of shape (V,)."""
        away, near = self._density.tree.query(mesh.vertices)
        return np.asarray(away), np.asarray(self._density.disks[near])

    def unsupported(self, mesh: Mesh) -> Mask:
        """Return which vertices, of shape (V,), have no point near whose normal is like theirs."""
        vertex, on_surface = self._on_surface(mesh)
        away, near = self._density.tree.query(mesh.vertices, k=min(self.parameters.ring_points, len(vertex)))
        cosines = np.abs(np.einsum("vi,vki->vk", mesh.vertex_normals(), self._normals[near]))
        supported = (away < self.parameters.near_disks * self._density.disks[near]) & on_surface[near]
        supported &= cosines > self.parameters.normal_cosine
        return np.asarray(~supported.any(axis=1))

    @cached_property
    def _normals(self) -> Float:
        """Normals of either sign of the planes of each point and those around it, of shape (N, 3).

        The surface's own normals would be wrong: a point at the end of a tunnel lies nearest to the tunnel's wall.
        """
        points = self._density.points
        around = points[self._density.tree.query(points, k=min(self.parameters.ring_points + 1, len(points)))[1]]
        return plane_normals(around)

    def uncovered(self, mesh: Mesh, disks: Float, loops: Sequence[Loop]) -> list[Loop]:
        """Return the loops that are short, and about which the normals of nearby points leave a wide angle free."""
        if not loops:
            return []
        vertex, on_surface = self._on_surface(mesh)
        vertex = vertex[on_surface]
        places, normals = cKDTree(mesh.vertices[vertex]), mesh.vertex_normals()[vertex]
        kept = []
        for loop in loops:
            ring, disk = mesh.vertices[loop.vertices], float(disks[loop.vertices].mean())
            limits = self.parameters.loop_rims_and_free_angles
            limit = next((angle for rims, angle in limits if loop.length <= rims * (2 * np.pi) * disk), None)
            if limit is not None:
                near = np.unique(np.concatenate(places.query_ball_point(ring, self.parameters.near_disks * disk)))
                if self._free_angle(ring, normals[near.astype(np.int64)]) > limit:
                    kept.append(loop)
        return kept

    def _free_angle(self, ring: Float, normals: Float) -> float:
        """Return the largest angle about a ring's axis without a normal, from arrays of shapes (L, 3) and (N, 3)."""
        arms = ring - ring.mean(axis=0)
        axis = np.cross(arms, np.roll(arms, -1, axis=0)).sum(axis=0)
        size = float(np.linalg.norm(axis))
        if size == 0:
            return 2 * np.pi
        axis /= size
        return widest_gap(normals[np.abs(normals @ axis) < self.parameters.axis_cosine], axis)

    def _on_surface(self, mesh: Mesh) -> tuple[Int, Mask]:
        """Return the vertex nearest to each point, and which points lie on the surface; both of shape (N,)."""
        away, vertex = cKDTree(mesh.vertices).query(self._density.points)
        return vertex, away < self.parameters.surface_disks * self._density.disks


def _is_neck(mesh: Mesh, normals: Float, loop: Loop) -> bool:
    """Return whether a loop runs around solid material: the vertices' normals, of shape (V, 3), point away from it."""
    ring = mesh.vertices[loop.vertices]
    return float(((ring - ring.mean(axis=0)) * normals[loop.vertices]).sum()) > 0


def _independent(mesh: Mesh, loops: Sequence[Loop], most: int) -> list[Loop]:
    """Return at most so many of the shortest loops without common neighbours that together do not separate the mesh."""
    start, end = mesh.faces.reshape(-1), np.roll(mesh.faces, -1, axis=1).reshape(-1)
    # Loops without common neighbours can be cut at once, since the caps of one do not touch those of another.
    table = csr_array((np.ones(len(start), dtype=bool), (start, end)), shape=(len(mesh.vertices),) * 2)
    used = np.zeros(len(mesh.vertices), dtype=bool)
    basis: list[int] = []
    kept = []
    for loop in loops:
        signature = loop.signature
        # Gaussian elimination over Z/2, with the basis in descending order: zero is left of what depends on it.
        for one in basis:
            signature = min(signature, signature ^ one)
        around = np.append(loop.vertices, table[loop.vertices].indices)
        if signature == 0 or used[around].any():
            continue
        used[around] = True
        basis = sorted([*basis, signature], reverse=True)
        kept.append(loop)
        if len(kept) == most:
            break
    return kept


def _cut_and_cap(mesh: Mesh, loops: Sequence[Loop], support: _PointSupport) -> Mesh | None:
    """Return the mesh cut along loops and capped, or None where there are none or the result is not sound."""
    if not loops:
        return None
    closed, reach = _cap_loops(mesh, loops)
    smooth = _fair(closed, reach, support.unsupported(closed), support.parameters)
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
    # Faces on the two sides of an edge of a loop belong to two fans from here on.
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
    # A middle gets the normal and attributes of a vertex on its rim.
    origin = np.append(origin, origin[begin[np.unique(cap, return_index=True)[1]]])
    attributes = {name: values[origin] for name, values in mesh.attributes.items()}
    normals = None if mesh.normals is None else mesh.normals[origin]
    return Mesh(np.concatenate([vertices, middles]), faces, normals, attributes), reach


def _fair(mesh: Mesh, reach: Float, unsupported: Mask, parameters: HandleParameters) -> Mesh:
    """Return the mesh with its caps and their surroundings faired.

    With the other vertices fixed, it minimises the sum of squares of each vertex's offset from the mean of its
    neighbours.

    Parameters
    ----------
    mesh : whose last vertices are the middles of caps
    reach : of shape (C,), length of each cap's loop
    unsupported : of shape (V,), which vertices no points support, as the rest of a neck
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
        free |= np.isfinite(dijkstra(stubs, indices=cap, limit=parameters.stub_lengths * length))
        free |= np.isfinite(dijkstra(paths, indices=cap, limit=parameters.fairing_lengths * length))
    means = csr_array((np.ones(len(start)), (start, end)), shape=(size, size))
    offsets = diags_array(1.0 / means.sum(axis=1)) @ means - eye_array(size)
    rows = np.flatnonzero(abs(offsets) @ free)
    inner, outer = offsets[rows][:, np.flatnonzero(free)], offsets[rows][:, np.flatnonzero(~free)]
    # Large coordinates would cancel.
    middle = mesh.vertices[free].mean(axis=0)
    vertices = mesh.vertices.copy()
    vertices[free] = middle - splu((inner.T @ inner).tocsc()).solve(inner.T @ (outer @ (vertices[~free] - middle)))
    smooth = mesh.with_vertices(vertices)
    if mesh.normals is None:
        return smooth
    by_faces = Mesh(vertices, mesh.faces).vertex_normals()
    return replace(smooth, normals=np.where(free[:, None], by_faces, mesh.normals))
