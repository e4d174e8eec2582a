"""Collapses short edges and splits long ones of a surface.

An edge collapses into its end of the higher kind (corner, crease, smooth), or into its middle when both are of one
kind. It may do so when the topology and the shape stay: the ends share no neighbours but the two opposite vertices (the
link condition, by which a closed 2-manifold stays one of the same genus), creases neither vanish nor merge, no face
turns away from its surroundings, and no edge becomes too long. Collapses that touch no common face are made at once,
the shortest edges first. The entries are `collapse_short`, `collapse_coincident` and `split_long`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array

from gnrecon.export.export_parameters import ExportParameters, RemeshParameters
from gnrecon.export.remeshing.edge_table import (
    CreasedSurface,
    EdgeTable,
    VertexKind,
    area_vectors,
    face_normals,
    independent_rings,
    ranks,
    unit,
)
from gnrecon.geometry.arrays import Float, Int, Mask
from gnrecon.geometry.mesh import Mesh


@dataclass(frozen=True)
class _Collapses:
    """Vertices that vanish and that are kept, of shape (N,), with the latter's places and normals, of shape (N, 3)."""

    gone: Int
    kept: Int
    place: Float
    normal: Float

    def only(self, mask: Mask) -> _Collapses:
        return _Collapses(self.gone[mask], self.kept[mask], self.place[mask], self.normal[mask])


def collapse_short(
    surface: CreasedSurface,
    length: Float,
    *,
    most_rounds: int = 15,
    parameters: RemeshParameters = ExportParameters.remesh,
) -> tuple[CreasedSurface, Float]:
    """Collapse edges shorter than 4/5 of the target length, of shape (V,), where that is safe.

    The first few of at most `most_rounds` do most of the work; the next iteration of remeshing retries the rest.

    Returns
    -------
    CreasedSurface, array
        The surface without unused vertices, and the target lengths at those that are left.
    """
    # Edges that were unsafe once are not tried again, so that they do not keep their neighbours from collapsing.
    refused = np.empty(0, dtype=np.int64)
    size = len(surface.vertices)
    for _ in range(most_rounds):
        edges = EdgeTable.of(surface.faces)
        names = edges.ends @ np.array([size, 1])
        wanted = _collapsible(surface, edges, length, parameters.short_edge_ratio) & ~np.isin(names, refused)
        chosen = _independent(surface, edges, wanted)
        if not len(chosen):
            break
        collapses = _collapse_targets(surface, edges.ends[chosen])
        good = _keeps_topology(edges, chosen, size) & _keeps_shape(
            surface, collapses, length, parameters.long_edge_ratio
        )
        refused = np.union1d(refused, names[chosen[~good]])
        surface = _collapse(surface, collapses.only(good))
    used = np.unique(surface.faces)
    return surface.compact(), length[used]


def collapse_coincident(mesh: Mesh) -> Mesh:
    """Collapse the edges of a closed, oriented 2-manifold whose ends are at one place, where the topology allows it.

    Vertices that no face uses stay.
    """
    faces, size = mesh.faces, len(mesh.vertices)
    while True:
        edges = EdgeTable.of(faces)
        first, second = np.moveaxis(mesh.vertices[edges.ends], 1, 0)
        wanted = np.flatnonzero((first == second).all(axis=1))
        wanted = wanted[_keeps_topology(edges, wanted, size)]
        chosen = wanted[independent_rings(edges.ends[wanted], np.arange(len(wanted)), faces, size)]
        if not len(chosen):
            return Mesh(mesh.vertices, faces, mesh.normals)
        names = np.arange(size)
        names[edges.ends[chosen, 1]] = edges.ends[chosen, 0]
        faces = names[faces]
        faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]


def _collapsible(surface: CreasedSurface, edges: EdgeTable, length: Float, short_ratio: float) -> Mask:
    """Which edges are shorter than a ratio of the target length and may collapse as far as creases are concerned."""
    a, b = edges.ends.T
    short = np.linalg.norm(surface.vertices[a] - surface.vertices[b], axis=1) < short_ratio * np.minimum(
        length[a], length[b]
    )
    low = surface.kinds()[edges.ends].min(axis=1)
    along = surface.is_crease(edges.ends) & (low < VertexKind.CORNER) & ~_in_crease_triangle(surface, edges)
    wanted: Mask = short & ((low == VertexKind.SMOOTH) | along)
    return wanted


def _in_crease_triangle(surface: CreasedSurface, edges: EdgeTable) -> Mask:
    """Which edges have a face whose other two edges are creases: a collapse would make these coincide."""
    sides = [
        surface.is_crease(np.sort(np.stack([edges.ends[:, end], edges.opposite[:, face]], axis=1), axis=1))
        for face in (0, 1)
        for end in (0, 1)
    ]
    return (sides[0] & sides[1]) | (sides[2] & sides[3])


def _independent(surface: CreasedSurface, edges: EdgeTable, wanted: Mask) -> Int:
    """Numbers of wanted edges that touch no common face, the shortest first."""
    rows = np.flatnonzero(wanted)
    ends = edges.ends[rows]
    lengths = np.linalg.norm(surface.vertices[ends[:, 0]] - surface.vertices[ends[:, 1]], axis=1)
    return rows[independent_rings(ends, ranks(lengths), surface.faces, len(surface.vertices))]


def _collapse_targets(surface: CreasedSurface, ends: Int) -> _Collapses:
    """Decide for each edge, of shape (N, 2), which end stays, and where."""
    kinds = surface.kinds()[ends]
    # The end of the higher kind stays in place, so that corners and creases keep their position.
    kept = np.where(kinds[:, 0] > kinds[:, 1], ends[:, 0], ends[:, 1])
    even = (kinds[:, 0] == kinds[:, 1])[:, None]
    place = np.where(even, surface.vertices[ends].mean(axis=1), surface.vertices[kept])
    normal = np.where(even, unit(surface.normals[ends].sum(axis=1)), surface.normals[kept])
    return _Collapses(ends.sum(axis=1) - kept, kept, place, normal)


def _keeps_topology(edges: EdgeTable, chosen: Int, size: int) -> Mask:
    """Link condition; the opposite vertices must be left with three neighbours."""
    both = np.concatenate([edges.ends, edges.ends[:, ::-1]])
    links = coo_array((np.ones(len(both), dtype=np.int8), both.T), shape=(size, size)).tocsr()
    a, b = edges.ends[chosen].T
    common = np.asarray(links[a].multiply(links[b]).sum(axis=1)).reshape(-1)
    # Fewer than three neighbours would leave two faces on the same three vertices.
    valence = np.bincount(both[:, 0], minlength=size)
    safe: Mask = (common == 2) & (valence[edges.opposite[chosen]] > 3).all(axis=1)
    return safe


def _keeps_shape(
    surface: CreasedSurface, collapses: _Collapses, length: Float, long_ratio: float, *, least_cosine: float = 0.5
) -> Mask:
    """Whether no face turns and no edge becomes too long, each of shape (N,).

    A face turns where the cosine between its new normal and what `face_normals` expects is below `least_cosine`. An
    edge is too long beyond a ratio of the target length, unless it was longer before.
    """
    count = len(collapses.gone)
    owner = np.full(len(surface.vertices), -1, dtype=np.int64)
    owner[collapses.gone] = owner[collapses.kept] = np.arange(count)
    owners = owner[surface.faces].max(axis=1)
    after = _collapse(surface, collapses, drop=False)
    changed = np.flatnonzero(owners >= 0)
    faces = after.faces[changed]
    # The two faces of the collapsed edge vanish and are not checked.
    whole = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    changed, faces = changed[whole], faces[whole]
    areas = area_vectors(after.vertices, faces)
    along = np.einsum("ij,ij->i", areas, face_normals(surface)[changed])
    bad = ~(along > least_cosine * np.linalg.norm(areas, axis=1))
    a, b = after.vertices[faces], after.vertices[np.roll(faces, -1, axis=1)]
    limit = long_ratio * np.minimum(length[faces], length[np.roll(faces, -1, axis=1)])
    before = surface.vertices[surface.faces[changed]]
    grown = np.linalg.norm(a - b, axis=2) > np.maximum(
        limit, np.linalg.norm(before - np.roll(before, -1, axis=1), axis=2)
    )
    bad |= grown.any(axis=1)
    good: Mask = np.bincount(owners[changed], weights=bad, minlength=count) == 0
    return good


def _collapse(surface: CreasedSurface, collapses: _Collapses, *, drop: bool = True) -> CreasedSurface:
    """Replace the vanishing vertices; `drop` removes the faces and creases that have lost an edge."""
    names = np.arange(len(surface.vertices))
    names[collapses.gone] = collapses.kept
    vertices, normals = surface.vertices.copy(), surface.normals.copy()
    vertices[collapses.kept], normals[collapses.kept] = collapses.place, collapses.normal
    faces, creases = names[surface.faces], names[surface.creases]
    if not drop:
        return CreasedSurface(vertices, normals, faces, surface.creases)
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    creases = np.unique(np.sort(creases[creases[:, 0] != creases[:, 1]], axis=1), axis=0)
    return CreasedSurface(vertices, normals, faces, creases)


# A face keeps its outline: with one, two or three of its edges split it becomes two, three or four faces, so that the
# pieces of neighbours always fit. With two split edges, the remaining quadrilateral is cut along its shorter diagonal.


def split_long(
    surface: CreasedSurface,
    length: Float,
    *,
    most_rounds: int = 12,
    long_ratio: float = ExportParameters.remesh.long_edge_ratio,
) -> tuple[CreasedSurface, Float]:
    """Halve edges that are longer than 4/3 of the target length, of shape (V,), until none is.

    With `most_rounds` an edge may be 4096 times too long.

    Returns
    -------
    CreasedSurface, array
        The new surface, whose first V vertices are the old ones, and the target lengths at its vertices.
    """
    for _ in range(most_rounds):
        edges = EdgeTable.of(surface.faces)
        a, b = edges.ends.T
        lengths = np.linalg.norm(surface.vertices[a] - surface.vertices[b], axis=1)
        long = lengths > long_ratio * 0.5 * (length[a] + length[b])
        if not long.any():
            break
        middles = 0.5 * (surface.vertices[a[long]] + surface.vertices[b[long]])
        length = np.concatenate([length, 0.5 * (length[a[long]] + length[b[long]])])
        surface = split(surface, edges, long, middles)
    return surface, length


def split(
    surface: CreasedSurface, edges: EdgeTable, marked: Mask, points: Float, centres: Float | None = None
) -> CreasedSurface:
    """Split the marked edges, a mask of shape (E,), at the given points, of shape (M, 3), in the edges' order.

    The new vertices follow the old ones in the same order. Where `centres` is given, of shape (T, 3), each of the T
    faces with all edges split is divided into six around it instead of into four, in the faces' order.
    """
    count = len(surface.vertices)
    middle = _middles(edges, marked, len(surface.faces), count)
    normals = [surface.normals, unit(surface.normals[edges.ends[marked]].sum(axis=1))]
    split_edges = (middle >= 0).sum(axis=1)
    vertices = np.concatenate([surface.vertices, points])
    # One split edge comes first; an edge that is left whole while the two others are split comes last.
    first = np.where(split_edges == 1, (middle >= 0).argmax(axis=1), (middle < 0).argmax(axis=1) + 1)
    turn = (np.where(split_edges % 3 == 0, 0, first)[:, None] + np.arange(3)) % 3
    corner, middle = np.take_along_axis(surface.faces, turn, 1), np.take_along_axis(middle, turn, 1)
    parts = [surface.faces[split_edges == 0]]
    parts += _halves(corner[split_edges == 1], middle[split_edges == 1])
    parts += _thirds(corner[split_edges == 2], middle[split_edges == 2], vertices)
    full = split_edges == 3
    if centres is None:
        parts += _quarters(corner[full], middle[full])
    else:
        parts += _fans(corner[full], middle[full], len(vertices) + np.arange(len(centres)))
        vertices = np.concatenate([vertices, centres])
        normals.append(unit(surface.normals[corner[full]].sum(axis=1)))
    return CreasedSurface(
        vertices, np.concatenate(normals), np.concatenate(parts), _split_creases(surface, edges, marked)
    )


def _middles(edges: EdgeTable, marked: Mask, faces: int, first: int) -> Int:
    """New vertex on each face's k-th edge, from its k-th to its next corner, of shape (F, 3); -1 for none."""
    middle = np.full((faces, 3), -1, dtype=np.int64)
    middle.reshape(-1)[edges.half_edges[marked]] = first + np.arange(np.count_nonzero(marked))[:, None]
    return middle


def _halves(corner: Int, middle: Int) -> list[Int]:
    (a, b, c), ab = corner.T, middle[:, 0]
    return [np.stack([a, ab, c], 1), np.stack([ab, b, c], 1)]


def _thirds(corner: Int, middle: Int, vertices: Float) -> list[Int]:
    (a, b, c), ab, bc = corner.T, middle[:, 0], middle[:, 1]
    to_c = np.linalg.norm(vertices[ab] - vertices[c], axis=1) < np.linalg.norm(vertices[a] - vertices[bc], axis=1)
    return [
        np.stack([ab, b, bc], 1),
        np.stack([ab, bc, np.where(to_c, c, a)], 1),
        np.stack([a, np.where(to_c, ab, bc), c], 1),
    ]


def _quarters(corner: Int, middle: Int) -> list[Int]:
    (a, b, c), (ab, bc, ca) = corner.T, middle.T
    return [np.stack(face, 1) for face in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]


def _fans(corner: Int, middle: Int, centre: Int) -> list[Int]:
    ring = np.stack([corner, middle], axis=2).reshape(-1, 6)
    return [np.stack([ring[:, k], ring[:, (k + 1) % 6], centre], 1) for k in range(6)]


def _split_creases(surface: CreasedSurface, edges: EdgeTable, marked: Mask) -> Int:
    """Creases with the split ones replaced by their halves, whose new vertex has the higher number."""
    ends, middles = edges.ends[marked], len(surface.vertices) + np.arange(np.count_nonzero(marked))
    cut = surface.is_crease(ends)
    size = len(surface.vertices)
    whole = ~np.isin(surface.creases @ np.array([size, 1]), ends @ np.array([size, 1]))
    halves = [np.stack([ends[cut, side], middles[cut]], axis=1) for side in (0, 1)]
    return np.concatenate([surface.creases[whole], *halves])
