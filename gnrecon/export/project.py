"""Bring a mesh's vertices onto the zero level by Newton's method along the gradient.

Each step is x <- x - f grad f / |grad f|^2, the orthogonal Newton step of the paper (section on surface sampling). A
vertex keeps its step only where |f| falls, and its old place where it would have to go further than a limit: there the
linear model does not hold, or the vertex sits on the cap that closes the field at its box. Afterwards, vertices of
faces that have turned over or collapsed go back, until none is left.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
import numpy.typing as npt

from gnrecon.geometry.arrays import Float, Int, Mask
from gnrecon.geometry.mesh import Mesh, area_vectors
from gnrecon.geometry.point_cloud import Frame
from gnrecon.runtime.errors import UsageError
from gnrecon.runtime.parallel import slices
from gnrecon.runtime.progress import ProgressCallback, ignore_progress

TURN, COLLAPSE = 0.3, 1e-3
"""Least cosine between a face's old and new normal, and least new area as a share of the old."""

FAR = 0.05
"""Length of a step, as a share of the limit, beyond which the gradient is asked for anew: it costs as much as two or
three values, and over a fiftieth of a cell, which most steps are shorter than, it hardly turns."""

CLOSE = 1e-8
"""Distance, as a share of the limit, below which a vertex is on the zero level and takes no further step."""

_TINY = np.finfo(np.float64).tiny


def project(
    mesh: Mesh,
    field: SignedDistance,
    *,
    steps: int = 3,
    limit: float | None = None,
    rough: SignedDistance | None = None,
    batch: int = 65536,
    advance: ProgressCallback = ignore_progress,
) -> Mesh:
    """Move vertices onto the zero level and give them normals.

    Parameters
    ----------
    mesh : Mesh
        As `extract` returns it, in file units.
    field : SignedDistance
        The field that it was extracted from.
    steps : int
        Newton steps; two bring a smooth field to rounding.
    limit : float, file units, optional
        Longest way that a vertex may go; by default half the median edge, which is less than half a cell.
    rough : SignedDistance, optional
        The same field, cheaper and a little less exact. It then gives the gradients, along which steps go by the
        field's own values.
    batch : int
        Most points to ask the field for at once.
    advance : callable
        Told of the share that is done after each batch.

    Returns
    -------
    Mesh
        The same faces; vertex normals are the field's unit gradients, and the faces' mean on caps.

    Raises
    ------
    UsageError
        When `steps` is negative or `limit` not positive.
    """
    if steps < 0:
        raise UsageError(f"The number of Newton steps is {steps}, but cannot be negative.")
    if limit is None:
        limit = 0.5 * float(np.median(side_lengths(mesh)))
    if not limit > 0:
        raise UsageError(f"The limit is {limit} file units, but must be positive.")
    moved = np.empty_like(mesh.vertices)
    value = np.empty(len(moved))
    gradient = np.empty_like(moved)
    for rows in slices(len(moved), batch):
        moved[rows], value[rows], gradient[rows] = newton_project(mesh.vertices[rows], field, steps, limit, rough)
        advance(rows.stop / len(moved))
    back = _vertices_to_restore(mesh, moved)
    moved[back] = mesh.vertices[back]
    result = Mesh(moved, mesh.faces)
    normals = result.vertex_normals()
    for rows in slices(len(moved)):
        unit = gradient[rows] / np.maximum(np.linalg.norm(gradient[rows], axis=1, keepdims=True), _TINY)
        # On a cap, and where the field folds, the gradient is not the surface's normal.
        fit = (np.abs(value[rows]) <= limit) & (np.einsum("ij,ij->i", unit, normals[rows]) > 0)
        normals[rows][fit] = unit[fit]
    return Mesh(moved, mesh.faces, normals)


def side_lengths(mesh: Mesh) -> npt.NDArray[np.float32]:
    """Lengths of the faces' sides, of shape (3 F,)."""
    lengths = np.empty((len(mesh.faces), 3), dtype=np.float32)
    for rows in slices(len(mesh.faces)):
        corners = mesh.vertices[mesh.faces[rows]]
        lengths[rows] = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2)
    return lengths.reshape(-1)


def newton_project(
    start: Float, field: SignedDistance, steps: int, limit: float, rough: SignedDistance | None = None
) -> tuple[Float, Float, Float]:
    """Points of shape (N, 3) after Newton steps no farther than `limit` from `start`, with value and gradient there.

    The gradient is that of where a point came from if its step was short; with a rough field, see `project`, its own.
    """
    points = start.copy()
    value, gradient = sdf_and_gradient(rough or field, points)
    if rough is not None and steps:
        value = field.sdf(points)
    for _ in range(steps):
        rows, trial = _newton_steps(points, value, gradient, start, limit, field.bounds)
        if not len(rows):
            break
        trial_value = field.sdf(trial)
        better = np.abs(trial_value) < np.abs(value[rows])
        rows, trial, trial_value = rows[better], trial[better], trial_value[better]
        far = np.linalg.norm(trial - points[rows], axis=1) > FAR * limit
        # The slope along the step, as it turned out: where the gradient is kept the next step is a secant's.
        gradient[rows] *= (1.0 - trial_value / value[rows])[:, None]
        points[rows], value[rows] = trial, trial_value
        gradient[rows[far]] = (rough or field).gradient(trial[far])
    return points, value, gradient


def _newton_steps(
    points: Float, value: Float, gradient: Float, start: Float, limit: float, bounds: Float
) -> tuple[Int, Float]:
    """Rows that may take a Newton step, of shape (S,), and where it leads them, of shape (S, 3)."""
    low, high = bounds
    slopes = np.linalg.norm(gradient, axis=1)
    # From one side of the limit to the other is twice the limit; where the field is flat there is no step.
    rows = np.flatnonzero((np.abs(value) > CLOSE * limit * slopes) & (np.abs(value) <= 2 * limit * slopes))
    trial = points[rows] - (value[rows] / slopes[rows])[:, None] * (gradient[rows] / slopes[rows][:, None])
    near = np.linalg.norm(trial - start[rows], axis=1) <= limit
    near &= ((trial >= low) & (trial <= high)).all(axis=1)
    return rows[near], trial[near]


def _vertices_to_restore(mesh: Mesh, moved: Float) -> Mask:
    """Which vertices must stay, of shape (V,), so that no face turns over or collapses.

    Every round returns at least one more vertex, and a face whose three vertices have stayed is as before, so it ends.
    """
    back = np.zeros(len(moved), dtype=bool)
    while True:
        now = np.where(back[:, None], mesh.vertices, moved)
        again = np.zeros_like(back)
        for rows in slices(len(mesh.faces)):
            faces = mesh.faces[rows]
            again[faces[_flipped_or_collapsed(area_vectors(mesh.vertices, faces), area_vectors(now, faces))]] = True
        if not (again & ~back).any():
            return back
        back |= again


def _flipped_or_collapsed(old: Float, new: Float) -> Mask:
    """Which faces, of shape (F,), have turned over or collapsed, by their old and new area vectors."""
    along = np.einsum("ij,ij->i", old, new)
    before, after = np.linalg.norm(old, axis=1), np.linalg.norm(new, axis=1)
    return np.asarray((along < TURN * after * before) | (after < COLLAPSE * before))


# What the exporter needs to know of a field: a signed distance with its gradient, in the file's coordinates.


class SignedDistance(Protocol):
    """A scalar field whose zero level is the surface; a fitted network, or any function with these four members."""

    @property
    def frame(self) -> Frame:
        """The similarity between file coordinates and the unit ball around the shape."""
        ...

    @property
    def bounds(self) -> Float:
        """Lower and upper corner, of shape (2, 3) and in file units, of the box within which the field is trusted."""
        ...

    def sdf(self, points: Float) -> Float:
        """Signed distance in file units, of shape (N,), negative inside, at file coordinates of shape (N, 3)."""
        ...

    def gradient(self, points: Float) -> Float:
        """Gradient of the distance, of shape (N, 3) and without unit, at file coordinates of shape (N, 3)."""
        ...


def sdf_and_gradient(field: SignedDistance, points: Float) -> tuple[Float, Float]:
    """Return the distance, of shape (N,), and its gradient, of shape (N, 3), at points, of shape (N, 3).

    A field that can make both at once, by a method of this name, does: it costs about half.
    """
    both = getattr(field, "sdf_and_gradient", None)
    if both is None:
        return field.sdf(points), field.gradient(points)
    value, gradient = both(points)
    return value, gradient


def evaluates_blocks(field: SignedDistance) -> bool:
    """Return whether a field makes distances around centres faster than one by one, by a method ``sdf_around``."""
    return hasattr(field, "sdf_around")


def sdf_around(field: SignedDistance, centers: Float, offsets: Float) -> Float:
    """Return the distance, of shape (N, K), at K offsets, of shape (K, 3), from each of the centres, of shape (N, 3).

    A field that knows blocks, see `evaluates_blocks`, is asked for them.
    """
    around = getattr(field, "sdf_around", None)
    if around is None:
        return field.sdf((centers[:, None] + offsets).reshape(-1, 3)).reshape(len(centers), len(offsets))
    values: Float = around(centers, offsets)
    return values


# Where a mesh of vertices on a surface is farthest from it: at the centres of its faces and the midpoints of edges.


def face_sample_points(corners: Float) -> Float:
    """Return the centres and then the sides' midpoints, of shape (4 F, 3), of faces given by corners of (F, 3, 3)."""
    midpoints = (corners + np.roll(corners, -1, axis=1)) / 2
    return np.concatenate([corners.mean(axis=1), midpoints.reshape(-1, 3)])
