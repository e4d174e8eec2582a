"""How long edges should be: one length everywhere, or shorter ones where the surface bends.

An edge of length h on a surface of curvature k turns the normal by h k. The adapted length lets edges turn by the same
small angle everywhere, so that the distance between chord and surface is the same share of the radius of curvature
(after Dunyach, Vanderhaeghe, Barthe and Botsch, 2013, who fix the distance itself). It is measured from the field's
normals at the two ends of each edge. Lengths grow gradually from short to long, as isotropic triangles need it.
"""

from __future__ import annotations

import numpy as np

from gnrecon.export.surface import SMOOTH, EdgeTable, Surface
from gnrecon.geometry.arrays import Float

BEND = np.radians(15.0)
"""Angle by which an edge may turn: the chord is then 0.9 % of the radius of curvature off."""

FINEST = 1.0 / 8.0
"""Shortest adapted length, as a share of the longest."""

GROWTH = 0.4
"""Greatest slope of the length along the surface."""

SWEEPS = 12
"""Rounds of spreading short lengths to neighbours."""


def even_lengths(surface: Surface, length: float) -> Float:
    """The same target length at every vertex, of shape (V,)."""
    return np.full(len(surface.vertices), length)


def bent_lengths(surface: Surface, length: float, angle: float) -> Float:
    """Target lengths at the vertices, of shape (V,): `length` where flat, down to an eighth of it where curved.

    Edges at creases, and those that turn by more than `angle` degrees, say
    nothing about the curvature beside the crease.
    """
    edges = EdgeTable.of(surface.faces)
    a, b = edges.ends.T
    far = np.linalg.norm(surface.vertices[a] - surface.vertices[b], axis=1)
    # Between unit normals, the chord is as good as the angle up to the angles that count here.
    turn = np.linalg.norm(surface.normals[a] - surface.normals[b], axis=1)
    inner = (surface.kinds()[edges.ends] == SMOOTH).all(axis=1)
    smooth = inner & (turn < 2 * np.sin(np.radians(angle) / 2)) & (far > 0)
    wanted = np.clip(BEND * far[smooth] / np.maximum(turn[smooth], 1e-12), FINEST * length, length)
    lengths = np.full(len(surface.vertices), length)
    for end in (a, b):
        np.minimum.at(lengths, end[smooth], wanted)
    for _ in range(SWEEPS):
        reach = lengths + 0
        np.minimum.at(reach, a, lengths[b] + GROWTH * far)
        np.minimum.at(reach, b, lengths[a] + GROWTH * far)
        lengths = reach
    return lengths
