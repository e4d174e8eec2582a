"""Splitting edges of a surface, any number at once.

A face keeps its outline: with one, two or three of its edges split it becomes two, three or four faces, so that the
pieces of neighbours always fit. With two split edges, the remaining quadrilateral is cut along its shorter diagonal.
"""

from __future__ import annotations

import numpy as np

from gnrecon.export.surface import EdgeTable, Surface, unit
from gnrecon.geometry.arrays import Float, Int, Mask

LONG = 4.0 / 3.0
"""An edge is too long beyond this many target lengths: its halves are then nearer to the target than itself."""

PASSES = 12
"""Most rounds of halving; an edge may be 4096 times too long."""


def split_long(surface: Surface, length: Float) -> tuple[Surface, Float]:
    """Halve edges that are longer than 4/3 of the target length, of shape (V,), until none is.

    Returns
    -------
    Surface, array
        The new surface, whose first V vertices are the old ones, and the target lengths at its vertices.
    """
    for _ in range(PASSES):
        edges = EdgeTable.of(surface.faces)
        a, b = edges.ends.T
        long = np.linalg.norm(surface.vertices[a] - surface.vertices[b], axis=1) > LONG * 0.5 * (length[a] + length[b])
        if not long.any():
            break
        middles = 0.5 * (surface.vertices[a[long]] + surface.vertices[b[long]])
        length = np.concatenate([length, 0.5 * (length[a[long]] + length[b[long]])])
        surface = split(surface, edges, long, middles)
    return surface, length


def split(surface: Surface, edges: EdgeTable, marked: Mask, points: Float, centres: Float | None = None) -> Surface:
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
    return Surface(vertices, np.concatenate(normals), np.concatenate(parts), _split_creases(surface, edges, marked))


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


def _split_creases(surface: Surface, edges: EdgeTable, marked: Mask) -> Int:
    """Creases with the split ones replaced by their halves, whose new vertex has the higher number."""
    ends, middles = edges.ends[marked], len(surface.vertices) + np.arange(np.count_nonzero(marked))
    cut = surface.is_crease(ends)
    size = len(surface.vertices)
    whole = ~np.isin(surface.creases @ np.array([size, 1]), ends @ np.array([size, 1]))
    halves = [np.stack([ends[cut, side], middles[cut]], axis=1) for side in (0, 1)]
    return np.concatenate([surface.creases[whole], *halves])
