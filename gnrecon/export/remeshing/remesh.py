"""Isotropic remeshing on a field: nearly equilateral faces of a wanted size, with the field's edges kept.

Rounds of splitting long edges, collapsing short ones, flipping towards six neighbours and spreading vertices evenly, by
Botsch and Kobbelt ("A remeshing approach to multiresolution modeling", 2004). What they project onto the old mesh is
projected here onto the field itself, so that nothing is lost from round to round; creases, which the field shows at the
start, are followed by edges throughout.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gnrecon.export.project import SignedDistance, newton_project, project
from gnrecon.export.remeshing.edge_operators import collapse_short, split_long
from gnrecon.export.remeshing.edge_table import SMOOTH, CreasedSurface, EdgeTable, unit
from gnrecon.export.remeshing.flip_and_relax import (
    flip_for_angles,
    flip_for_valence,
    relax,
    snap_to_creases,
    without_flips,
)
from gnrecon.export.remeshing.sharpen import crease_edges
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.mesh import Mesh
from gnrecon.runtime.errors import UsageError

ROUNDS = 8

STEPS = 1
"""Newton steps after each round: vertices begin near the zero level, and the last round is followed by more."""


def remesh(mesh: Mesh, field: SignedDistance, length: float, *, adaptive: bool = False, angle: float = 30.0) -> Mesh:
    """Mesh a surface anew with edges of a target length.

    Parameters
    ----------
    mesh : Mesh
        Sound, in file units; from `sharpen` where the field has edges.
    field : SignedDistance
        Whose zero level the mesh is near.
    length : float, file units
        Of the edges.
    adaptive : bool
        Whether edges become shorter, down to an eighth, where the surface bends.
    angle : float
        Degrees between the field's normals on neighbouring faces from which on their edge is kept as a crease.

    Returns
    -------
    Mesh
        Closed and manifold, of the same genus, on the zero level, with the field's normals.

    Raises
    ------
    UsageError
        When the length is not positive.
    """
    if not 0 < length < np.inf:
        raise UsageError(f"The edge length is {length} file units, but must be positive.")
    surface = with_creases(mesh, field, angle)
    for _ in range(ROUNDS):
        lengths = adaptive_lengths(surface, length, angle) if adaptive else uniform_lengths(surface, length)
        surface, lengths = split_long(surface, lengths)
        surface, lengths = collapse_short(surface, lengths)
        surface = flip_for_valence(surface)
        surface = move_vertices(surface, relax(surface), field, angle)
    return project(flip_for_angles(surface).mesh(), field)


def with_creases(mesh: Mesh, field: SignedDistance, angle: float) -> CreasedSurface:
    """The mesh as a surface whose creases are the edges where the field turns by more than `angle` degrees."""
    edges = EdgeTable.of(mesh.faces)
    normals = unit(field.gradient(mesh.corners.mean(axis=1)))
    creases = edges.ends[crease_edges(normals, edges, angle)]
    return CreasedSurface(mesh.vertices, unit(field.gradient(mesh.vertices)), mesh.faces, creases).compact()


def move_vertices(surface: CreasedSurface, places: Float, field: SignedDistance, angle: float) -> CreasedSurface:
    """Move vertices to `places`, of shape (V, 3), from there onto creases and the zero level, where no face turns over.

    What would turn a face stays where it was, and with it on the zero level if it was there.
    """
    places = snap_to_creases(replace(surface, vertices=places), field, angle)
    edges = np.linalg.norm(np.diff(places[surface.faces], axis=1), axis=2)
    points, _, gradient = newton_project(places, field, STEPS, 0.5 * float(np.median(edges)))
    moved = without_flips(surface, points)
    stayed = (moved.vertices != points).any(axis=1)
    return replace(moved, normals=np.where(stayed[:, None], surface.normals, unit(gradient)))


BEND = np.radians(15.0)
"""Angle by which an edge may turn: the chord is then 0.9 % of the radius of curvature off."""

FINEST = 1.0 / 8.0
"""Shortest adapted length, as a share of the longest."""

GROWTH = 0.4
"""Greatest slope of the length along the surface."""

SWEEPS = 12
"""Rounds of spreading short lengths to neighbours."""


# How long edges should be: one length everywhere, or shorter ones where the surface bends.
#
# An edge of length h on a surface of curvature k turns the normal by h k. The adapted length lets edges turn by the
# same small angle everywhere, so that the distance between chord and surface is the same share of the radius of
# curvature (after Dunyach, Vanderhaeghe, Barthe and Botsch, 2013, who fix the distance itself). It is measured from the
# field's normals at the two ends of each edge. Lengths grow gradually from short to long, as isotropic triangles need
# it.


def uniform_lengths(surface: CreasedSurface, length: float) -> Float:
    """The same target length at every vertex, of shape (V,)."""
    return np.full(len(surface.vertices), length)


def adaptive_lengths(surface: CreasedSurface, length: float, angle: float) -> Float:
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
