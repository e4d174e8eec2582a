"""Short non-separating loops on a surface: one around each handle, one through each tunnel.

A closed path separates a surface if and only if it crosses every other closed path an even number of times (homology
with coefficients in Z/2). A spanning tree of the edges and a spanning tree of the faces that crosses none of them leave
2 g edges over, each of which closes one path over faces. Each of these paths gets a random word of 64 bits, and each
edge a signature: the exclusive or of the words of the paths that cross it. Then the exclusive or along any closed path
of edges is its homology class: zero where it separates the surface, and for any other with a chance of 2^-64. One pass
from the leaves of the faces' tree to its root gives the signatures of all edges, whatever the genus.

A path that does not separate the surface crosses one of those over faces. So the shortest ones are searched from the
vertices along these only, by Dijkstra's algorithm within half the longest length, many at once. The entry is
`short_loops`.
Sources: Eppstein, Dynamic generators of topologically embedded graphs (2003); Erickson and Whittlesey, Greedy optimal
homotopy and homology generators (2005).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, dijkstra, minimum_spanning_tree
from scipy.spatial import cKDTree

from gnrecon.export.mesh_statistics import Edges, face_components
from gnrecon.geometry.arrays import Float, Int, Mask
from gnrecon.geometry.mesh import Mesh
from gnrecon.runtime.chunks import slices

Signatures = npt.NDArray[np.uint64]


@dataclass(frozen=True)
class Loop:
    """A simple closed path of edges.

    Parameters
    ----------
    vertices : integer array of shape (L,)
        In order.
    length : float
    signature : int
        Its homology class: loops are independent where no exclusive or of some of their signatures is zero.
    """

    vertices: Int
    length: float
    signature: int


@dataclass(frozen=True)
class _Graph:
    """Vertices and edges of a closed mesh.

    Parameters
    ----------
    vertices : of shape (V, 3)
    ends : of shape (E, 2), lower and higher vertex of each edge
    lengths : of shape (E,)
    signatures : of shape (E,)
    """

    vertices: Float
    ends: Int
    lengths: Float
    signatures: Signatures

    @classmethod
    def of(cls, mesh: Mesh, rng: np.random.Generator) -> _Graph:
        """Return the graph of a closed, oriented 2-manifold."""
        edges = Edges.of(mesh)
        ends = edges.ends[edges.first]
        faces = np.stack([edges.corner[edges.first], edges.corner[edges.first + 1]], axis=1) // 3
        lengths = np.linalg.norm(mesh.vertices[ends[:, 0]] - mesh.vertices[ends[:, 1]], axis=1)
        return cls(mesh.vertices, ends, lengths, _edge_signatures(mesh, ends, faces, rng))

    @cached_property
    def _around(self) -> csr_array:
        return _links(self.ends, len(self.vertices))

    def neighbours(self, vertices: Int) -> tuple[Int, Int, Int]:
        """Return the position in `vertices`, of shape (N,), the neighbour and the edge of each pair of neighbours."""
        table = self._around
        count = np.diff(table.indptr)[vertices]
        position = np.repeat(np.arange(len(vertices)), count)
        slot = np.repeat(table.indptr[vertices] - np.cumsum(count) + count, count) + np.arange(count.sum())
        return position, table.indices[slot].astype(np.int64), table.data[slot].astype(np.int64) - 1


def short_loops(
    mesh: Mesh,
    longest: Float,
    sought: Mask,
    rng: np.random.Generator,
    *,
    source_spacing: float = 1 / 5,
    sources_at_once: int = 100,
) -> list[Loop]:
    """Return loops that do not separate the surface, shortest first.

    Each is the shortest one through some vertex, without the part that is walked there and back.

    Parameters
    ----------
    mesh : a closed, oriented 2-manifold
    longest : of shape (V,), the length up to which a loop through each vertex is searched
    sought : mask of shape (V,), of the vertices through which loops are searched
    rng : source of the random words
    source_spacing : between vertices that are searched from, in longest lengths: a loop near one is found from it
    sources_at_once : vertices that a thread searches from at once, which bounds the memory
    """
    # It imports torch, which checking a mesh does not need.
    from gnrecon.runtime.parallel import map_in_threads

    # By V - E + F = 2 (components - genus), with three edges for two faces: without a handle, every loop separates.
    if len(mesh.vertices) - len(mesh.faces) // 2 == 2 * (1 + int(face_components(mesh).max(initial=-1))):
        return []
    graph = _Graph.of(mesh, rng)
    crossed = np.unique(graph.ends[graph.signatures != 0])
    sources = _thin(graph.vertices, crossed[sought[crossed]], longest, source_spacing)
    tree = cKDTree(graph.vertices)
    batches = [sources[some] for some in slices(len(sources), sources_at_once)]
    found = map_in_threads(lambda some: _shortest_through(graph, tree, some, longest), batches)
    return sorted(itertools.chain.from_iterable(found), key=lambda loop: loop.length)


def _edge_signatures(mesh: Mesh, ends: Int, faces: Int, rng: np.random.Generator) -> Signatures:
    """Return each edge's signature, of shape (E,), from its ends and its two faces, each of shape (E, 2)."""
    count, size = len(mesh.vertices), len(mesh.faces)
    # A spanning tree of the vertices first, and then one of the faces that crosses none of its edges. What is left are
    # the 2 g edges that close the generators. Edges are numbered from 1, because 0 means no entry in a sparse matrix.
    left: Mask = np.ones(len(ends), dtype=bool)
    left[minimum_spanning_tree(_links(ends, count)).tocoo().data.astype(np.int64) - 1] = False
    across = _links(np.where(left[:, None], faces, 0), size)
    walks = []
    for root in np.unique(face_components(mesh), return_index=True)[1]:
        order, parent = breadth_first_order(across, root, directed=False)
        edge = np.zeros(len(order), dtype=np.int64)
        edge[1:] = np.asarray(across[order[1:], parent[order[1:]]]).reshape(-1) - 1
        left[edge[1:]] = False
        walks.append((order, parent[order], edge))
    # Each edge that is left crosses its own generator only: its signature is that generator's random word.
    rows = np.flatnonzero(left)
    signatures = np.zeros(len(ends), dtype=np.uint64)
    signatures[rows] = rng.integers(1, 2**64, len(rows), dtype=np.uint64)
    gathered = np.zeros(size, dtype=np.uint64)
    np.bitwise_xor.at(gathered, faces[rows].reshape(-1), np.repeat(signatures[rows], 2))
    # From the leaves up: a face passes on to its parent what it has gathered from its children.
    passed = gathered.tolist()
    for order, parent, edge in walks:
        for face, above in zip(order[:0:-1].tolist(), parent[:0:-1].tolist(), strict=True):
            passed[above] ^= passed[face]
        signatures[edge[1:]] = np.array(passed, dtype=np.uint64)[order[1:]]
    return signatures


def _links(pairs: Int, count: int) -> csr_array:
    """Return the symmetric matrix of `count` rows that holds each pair's number, from 1, but no pair of one row."""
    kept = np.flatnonzero(pairs[:, 0] != pairs[:, 1])
    low, high = pairs[kept].T
    numbers = np.concatenate([kept, kept]) + 1.0
    return csr_array((numbers, (np.concatenate([low, high]), np.concatenate([high, low]))), shape=(count, count))


def _thin(places: Float, rows: Int, longest: Float, spacing: float) -> Int:
    """Return some of the rows, one in each cube, whose edge is about `spacing` longest lengths."""
    # The cubes' edges are powers of two, so that neighbouring vertices with similar lengths share one grid.
    octave = np.floor(np.log2(spacing * longest[rows]))
    cube = np.floor(places[rows] / np.exp2(octave)[:, None])
    return rows[np.unique(np.column_stack([octave, cube]), axis=0, return_index=True)[1]]


def _shortest_through(graph: _Graph, tree: cKDTree, sources: Int, longest: Float) -> list[Loop]:
    """Return the shortest loop through each source that does not separate the surface, where there is one."""
    # No vertex of a loop is farther from its source, in a straight line, than half the loop's length.
    near = tree.query_ball_point(graph.vertices[sources], longest[sources] / 2)
    block = np.repeat(np.arange(len(sources)), [len(rows) for rows in near])
    vertex = np.concatenate([np.sort(rows) for rows in near]).astype(np.int64)
    # Each source has a copy of what is near it, so that one search serves all.
    names = block * len(graph.vertices) + vertex
    copy, end, edge = graph.neighbours(vertex)
    wanted = block[copy] * len(graph.vertices) + end
    other = np.minimum(np.searchsorted(names, wanted), len(names) - 1)
    kept = names[other] == wanted
    copy, other, edge = copy[kept], other[kept], edge[kept]
    links = csr_array((graph.lengths[edge], (copy, other)), shape=(len(names), len(names)))
    starts = np.searchsorted(names, np.arange(len(sources)) * len(graph.vertices) + sources)
    # Along the surface either, so that the search ends there; rounding is allowed for.
    most = float(longest[sources].max(initial=0.0)) / 2 * (1 + 1e-9)
    far, before, _ = dijkstra(links, indices=starts, min_only=True, limit=most, return_predecessors=True)
    reached = np.isfinite(far)
    signatures = _path_signatures(copy, other, graph.signatures[edge], before)
    length = far[copy] + far[other] + graph.lengths[edge]
    # An edge between two paths of one source closes a loop. It does not separate the surface where the signatures along
    # it do not cancel.
    closes = (
        reached[copy]
        & (signatures[copy] ^ signatures[other] != graph.signatures[edge])
        & (length <= longest[sources[block[copy]]])
    )
    rows = np.flatnonzero(closes)
    # The shortest of each source.
    rows = rows[np.lexsort([length[rows], block[copy[rows]]])]
    rows = rows[np.unique(block[copy[rows]], return_index=True)[1]]
    crossed = signatures[copy[rows]] ^ signatures[other[rows]] ^ graph.signatures[edge[rows]]
    found = []
    for row, signature in zip(rows, crossed, strict=True):
        ring = vertex[_simple_cycle(before, int(copy[row]), int(other[row]))]
        steps = graph.vertices[ring] - graph.vertices[np.roll(ring, -1)]
        found.append(Loop(ring, float(np.linalg.norm(steps, axis=1).sum()), int(signature)))
    return found


def _path_signatures(copy: Int, other: Int, signatures: Signatures, before: Int) -> Signatures:
    """Return the exclusive or of the signatures along the path from its start to each node."""
    found = np.zeros(len(before), dtype=np.uint64)
    last = before[other] == copy
    found[other[last]] = signatures[last]
    # Pointer jumping: each pass doubles the part of the path that is summed, so that a few passes are enough.
    jump = np.where(before < 0, np.arange(len(before)), before)
    while True:
        further = jump[jump]
        if (further == jump).all():
            return found
        found, jump = found ^ found[jump], further


def _simple_cycle(before: Int, one: int, other: int) -> list[int]:
    """Return the nodes of the closed path through two neighbours, without what their paths from the start share."""
    first, second = _path_from_source(before, one), _path_from_source(before, other)
    while len(first) > 1 and len(second) > 1 and first[-2] == second[-2]:
        first.pop()
        second.pop()
    return first + second[-2::-1]


def _path_from_source(before: Int, node: int) -> list[int]:
    path = [node]
    while before[path[-1]] >= 0:
        path.append(int(before[path[-1]]))
    return path
