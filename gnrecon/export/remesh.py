"""Isotropic remeshing on a field: nearly equilateral faces of a wanted size, with the field's edges kept.

Rounds of splitting long edges, collapsing short ones, flipping towards six neighbours and spreading vertices evenly, by
Botsch and Kobbelt ("A remeshing approach to multiresolution modeling", 2004). What they project onto the old mesh is
projected here onto the field itself, so that nothing is lost from round to round; creases, which the field shows at the
start, are followed by edges throughout.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gnrecon.export.collapse import collapse_short
from gnrecon.export.crease import crease_edges
from gnrecon.export.flip import flip_for_angles, flip_for_valence
from gnrecon.export.project import newton, project
from gnrecon.export.protocol import SignedDistance
from gnrecon.export.relax import guarded, on_creases, relaxed
from gnrecon.export.sizing import bent_lengths, even_lengths
from gnrecon.export.split import split_long
from gnrecon.export.surface import EdgeTable, Surface, unit
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
    surface = creased(mesh, field, angle)
    for _ in range(ROUNDS):
        lengths = bent_lengths(surface, length, angle) if adaptive else even_lengths(surface, length)
        surface, lengths = split_long(surface, lengths)
        surface, lengths = collapse_short(surface, lengths)
        surface = flip_for_valence(surface)
        surface = settled(surface, relaxed(surface), field, angle)
    return project(flip_for_angles(surface).mesh(), field)


def creased(mesh: Mesh, field: SignedDistance, angle: float) -> Surface:
    """The mesh as a surface whose creases are the edges where the field turns by more than `angle` degrees."""
    edges = EdgeTable.of(mesh.faces)
    normals = unit(field.gradient(mesh.corners.mean(axis=1)))
    creases = edges.ends[crease_edges(normals, edges, angle)]
    return Surface(mesh.vertices, unit(field.gradient(mesh.vertices)), mesh.faces, creases).compact()


def settled(surface: Surface, places: Float, field: SignedDistance, angle: float) -> Surface:
    """Move vertices to `places`, of shape (V, 3), from there onto creases and the zero level, where no face turns over.

    What would turn a face stays where it was, and with it on the zero level if it was there.
    """
    places = on_creases(replace(surface, vertices=places), field, angle)
    edges = np.linalg.norm(np.diff(places[surface.faces], axis=1), axis=2)
    points, _, gradient = newton(places, field, STEPS, 0.5 * float(np.median(edges)))
    moved = guarded(surface, points)
    stayed = (moved.vertices != points).any(axis=1)
    return replace(moved, normals=np.where(stayed[:, None], surface.normals, unit(gradient)))
