"""Isotropic remeshing on a field: nearly equilateral faces of a given size, with the field's sharp edges kept.

Rounds of splitting long edges, collapsing short ones, flipping towards six neighbours and relaxing vertices, by Botsch
and Kobbelt ("A remeshing approach to multiresolution modeling", 2004). They project onto the old mesh; here vertices
are projected onto the field itself, so that no detail is lost from round to round. Creases are detected from the field
at the start, and stay edges of the mesh. The entry is `remesh`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gnrecon.export.export_parameters import ExportParameters, RemeshParameters
from gnrecon.export.project import SignedDistance, newton_project, project
from gnrecon.export.remeshing.edge_operators import collapse_short, split_long
from gnrecon.export.remeshing.edge_table import CreasedSurface, EdgeTable, VertexKind, unit
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


def remesh(
    mesh: Mesh,
    field: SignedDistance,
    length: float,
    *,
    adaptive: bool = False,
    angle: float = 30.0,
    parameters: RemeshParameters = ExportParameters.remesh,
) -> Mesh:
    """Replace the faces of a mesh by nearly equilateral ones with edges of a target length.

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
    parameters : RemeshParameters

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
    for _ in range(parameters.rounds):
        if adaptive:
            lengths = adaptive_lengths(surface, length, angle, finest_share=parameters.finest_length_share)
        else:
            lengths = np.full(len(surface.vertices), length)
        surface, lengths = split_long(surface, lengths, long_ratio=parameters.long_edge_ratio)
        surface, lengths = collapse_short(surface, lengths, parameters=parameters)
        surface = flip_for_valence(surface)
        surface = move_vertices(surface, relax(surface), field, angle)
    return project(flip_for_angles(surface).mesh(), field)


def with_creases(mesh: Mesh, field: SignedDistance, angle: float) -> CreasedSurface:
    """The mesh as a surface whose creases are the edges where the field turns by more than `angle` degrees."""
    edges = EdgeTable.of(mesh.faces)
    normals = unit(field.gradient(mesh.corners.mean(axis=1)))
    creases = edges.ends[crease_edges(normals, edges, angle)]
    return CreasedSurface(mesh.vertices, unit(field.gradient(mesh.vertices)), mesh.faces, creases).compact()


def move_vertices(
    surface: CreasedSurface, places: Float, field: SignedDistance, angle: float, *, steps: int = 1
) -> CreasedSurface:
    """Move vertices to `places`, of shape (V, 3), and from there onto creases and the zero level by Newton steps.

    One step is enough, because vertices start near the zero level and `remesh` ends with more. A move that would turn a
    face over is not made; the vertex then keeps its old place, and stays on the zero level if it was there.
    """
    places = snap_to_creases(replace(surface, vertices=places), field, angle)
    edges = np.linalg.norm(np.diff(places[surface.faces], axis=1), axis=2)
    points, _, gradient = newton_project(places, field, steps, 0.5 * float(np.median(edges)))
    moved = without_flips(surface, points)
    # A vertex that was not moved keeps the normal of its old place.
    stayed = (moved.vertices != points).any(axis=1)
    return replace(moved, normals=np.where(stayed[:, None], surface.normals, unit(gradient)))


def adaptive_lengths(
    surface: CreasedSurface,
    length: float,
    angle: float,
    *,
    bend_degrees: float = 15.0,
    finest_share: float = ExportParameters.remesh.finest_length_share,
    growth: float = 0.4,
    sweeps: int = 12,
) -> Float:
    """Target lengths at the vertices, of shape (V,): `length` where flat, less where curved.

    An edge of length h on a surface of curvature k turns the normal by h k. The adapted length lets every edge turn by
    the same small angle, so that the distance between chord and surface is the same share of the radius of curvature
    (after Dunyach, Vanderhaeghe, Barthe and Botsch, 2013, who fix the distance itself). The angle is measured between
    the field's normals at the two ends of each edge. Edges at creases, and those that turn by more than `angle`
    degrees, are ignored. Lengths grow gradually from short to long, because isotropic triangles need it.

    Parameters
    ----------
    surface : CreasedSurface
    length : float
        The longest.
    angle : float
        Least angle of a crease, in degrees.
    bend_degrees : float
        Angle by which an edge may turn: the chord is then 0.9 % of the radius of curvature off.
    finest_share : float
        Shortest length, as a share of the longest.
    growth : float
        Greatest slope of the length along the surface.
    sweeps : int
        Rounds of spreading short lengths to neighbours.
    """
    edges = EdgeTable.of(surface.faces)
    a, b = edges.ends.T
    far = np.linalg.norm(surface.vertices[a] - surface.vertices[b], axis=1)
    # The chord between unit normals is close to the angle, for the angles that count here.
    turn = np.linalg.norm(surface.normals[a] - surface.normals[b], axis=1)
    inner = (surface.kinds()[edges.ends] == VertexKind.SMOOTH).all(axis=1)
    smooth = inner & (turn < 2 * np.sin(np.radians(angle) / 2)) & (far > 0)
    wanted = np.radians(bend_degrees) * far[smooth] / np.maximum(turn[smooth], 1e-12)
    wanted = np.clip(wanted, finest_share * length, length)
    # A vertex takes the shortest length that any of its edges asks for.
    lengths = np.full(len(surface.vertices), length)
    for end in (a, b):
        np.minimum.at(lengths, end[smooth], wanted)
    for _ in range(sweeps):
        reach = lengths + 0
        np.minimum.at(reach, a, lengths[b] + growth * far)
        np.minimum.at(reach, b, lengths[a] + growth * far)
        lengths = reach
    return lengths
