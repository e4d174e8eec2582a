"""Moves a mesh's vertices onto the zero level by Newton's method along the gradient.

Each step is x <- x - f grad f / |grad f|^2, the orthogonal Newton step of the paper (section on surface sampling). A
step is kept only where it reduces |f|. A vertex that would move farther than a limit stays: there the linear model does
not hold, or the vertex lies on the cap that closes the field at its box. Afterwards, vertices of faces that have turned
over or collapsed are restored, until none is left. The entry is `project`.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
import numpy.typing as npt

from gnrecon.geometry.arrays import Float, Int, Mask
from gnrecon.geometry.mesh import Mesh, area_vectors
from gnrecon.geometry.point_cloud import Frame
from gnrecon.runtime.chunks import slices
from gnrecon.runtime.errors import UsageError
from gnrecon.runtime.progress import ProgressCallback, ignore_progress


def project(
    mesh: Mesh,
    field: SignedDistance,
    *,
    steps: int = 3,
    limit: float | None = None,
    rough: SignedDistance | None = None,
    tolerance: float = 1e-8,
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
        Largest distance that a vertex may move; by default half the median edge, which is less than half a cell.
    rough : SignedDistance, optional
        The same field, cheaper and a little less accurate. It then gives the gradients and the values at the start;
        other values are the field's own.
    tolerance : float
        Vertices nearer to the zero level than this, in limits, take no further step.
    batch : int
        Most points to evaluate at once.
    advance : callable
        Receives the share that is done, after each batch.

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
        moved[rows], value[rows], gradient[rows] = newton_project(
            mesh.vertices[rows], field, steps, limit, rough, tolerance=tolerance
        )
        advance(rows.stop / len(moved))
    back = _vertices_to_restore(mesh, moved)
    moved[back] = mesh.vertices[back]
    return _with_field_normals(Mesh(moved, mesh.faces), value, gradient, limit)


def _with_field_normals(mesh: Mesh, value: Float, gradient: Float, limit: float) -> Mesh:
    """The mesh with the field's unit gradients as normals where they fit, and the faces' mean elsewhere."""
    normals = mesh.vertex_normals()
    # By slices, because temporaries of all vertices would double the memory.
    for rows in slices(len(normals)):
        lengths = np.linalg.norm(gradient[rows], axis=1, keepdims=True)
        unit = gradient[rows] / np.maximum(lengths, np.finfo(np.float64).tiny)
        # On a cap, and where the field folds, the gradient is not the surface's normal.
        fit = (np.abs(value[rows]) <= limit) & (np.einsum("ij,ij->i", unit, normals[rows]) > 0)
        normals[rows][fit] = unit[fit]
    return Mesh(mesh.vertices, mesh.faces, normals)


def side_lengths(mesh: Mesh) -> npt.NDArray[np.float32]:
    """Lengths of the faces' sides, of shape (3 F,)."""
    # Single precision halves the memory, and the median and the mean need no more.
    lengths = np.empty((len(mesh.faces), 3), dtype=np.float32)
    for rows in slices(len(mesh.faces)):
        corners = mesh.vertices[mesh.faces[rows]]
        lengths[rows] = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2)
    return lengths.reshape(-1)


def newton_project(
    start: Float,
    field: SignedDistance,
    steps: int,
    limit: float,
    rough: SignedDistance | None = None,
    *,
    tolerance: float = 1e-8,
    gradient_reuse_limits: float = 0.05,
) -> tuple[Float, Float, Float]:
    """Move points of shape (N, 3) by Newton steps, and return them with the value and the gradient there.

    Points stay within `limit` of their start. After a step shorter than `gradient_reuse_limits`, in limits, the old
    gradient is kept: a gradient costs as much as two or three values, and over a fiftieth of a cell, which most steps
    are shorter than, it hardly changes. With a rough field, see `project`, gradients are that field's, and so is the
    value at the start: nearly all points then need one value of the field itself. Points nearer than `tolerance`, in
    limits, take no further step.
    """
    points = start.copy()
    value, gradient = sdf_and_gradient(rough or field, points)
    for number in range(steps):
        # Of rough values, none is near enough.
        from_rough = rough is not None and number == 0
        near_enough = -1.0 if from_rough else tolerance
        rows, trial = _newton_steps(points, value, gradient, start, limit, field.bounds, near_enough)
        if not len(rows):
            break
        trial_value = field.sdf(trial)
        # A step that does not reduce the field's magnitude is not taken: the linear model failed. A rough value that is
        # smaller than the difference of both fields says nothing about that.
        allowed = gradient_reuse_limits * limit * np.linalg.norm(gradient[rows], axis=1) if from_rough else 0.0
        better = np.abs(trial_value) < np.maximum(np.abs(value[rows]), allowed)
        rows, trial, trial_value = rows[better], trial[better], trial_value[better]
        far = np.linalg.norm(trial - points[rows], axis=1) > gradient_reuse_limits * limit
        if not from_rough:
            # Scaled to the slope observed along the step: where the gradient is kept, the next step is a secant step.
            gradient[rows] *= (1.0 - trial_value / value[rows])[:, None]
        points[rows], value[rows] = trial, trial_value
        gradient[rows[far]] = (rough or field).gradient(trial[far])
    return points, value, gradient


def _newton_steps(
    points: Float,
    value: Float,
    gradient: Float,
    start: Float,
    limit: float,
    bounds: Float,
    tolerance: float,
) -> tuple[Int, Float]:
    """Rows that may take a Newton step, of shape (S,), and where it leads them, of shape (S, 3).

    Points nearer to the zero level than `tolerance`, in limits, take none.
    """
    low, high = bounds
    slopes = np.linalg.norm(gradient, axis=1)
    # From one side of the limit to the other is twice the limit; where the field is flat there is no step.
    open_rows = np.abs(value) > tolerance * limit * slopes
    rows = np.flatnonzero(open_rows & (np.abs(value) <= 2 * limit * slopes))
    trial = points[rows] - (value[rows] / slopes[rows])[:, None] * (gradient[rows] / slopes[rows][:, None])
    near = np.linalg.norm(trial - start[rows], axis=1) <= limit
    # Outside its box a field is not defined by data.
    near &= ((trial >= low) & (trial <= high)).all(axis=1)
    return rows[near], trial[near]


def _vertices_to_restore(mesh: Mesh, moved: Float) -> Mask:
    """Which vertices to restore, of shape (V,), so that no face turns over or collapses.

    It ends, because each round restores at least one more vertex, and a face with three restored vertices is as before.
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


def _flipped_or_collapsed(old: Float, new: Float, *, least_cosine: float = 0.3, least_area_ratio: float = 1e-3) -> Mask:
    """Which faces, of shape (F,), have turned over or collapsed, by their old and new area vectors.

    They have where the normal's cosine to the old one is below `least_cosine`, or the area below a share of the old.
    """
    along = np.einsum("ij,ij->i", old, new)
    before, after = np.linalg.norm(old, axis=1), np.linalg.norm(new, axis=1)
    return np.asarray((along < least_cosine * after * before) | (after < least_area_ratio * before))


# What meshing needs of a field: a signed distance with its gradient, in the file's coordinates.


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

    A field with a method of this name computes both at once, at about half the cost.
    """
    both = getattr(field, "sdf_and_gradient", None)
    if both is None:
        return field.sdf(points), field.gradient(points)
    value, gradient = both(points)
    return value, gradient


def evaluates_blocks(field: SignedDistance) -> bool:
    """Return whether a field has a method ``sdf_around``, which evaluates points around centres faster."""
    return hasattr(field, "sdf_around")


def sdf_around(field: SignedDistance, centers: Float, offsets: Float) -> Float:
    """Return the distance, of shape (N, K), at K offsets, of shape (K, 3), from each of the centres, of shape (N, 3).

    A field's own method is used, see `evaluates_blocks`.
    """
    around = getattr(field, "sdf_around", None)
    if around is None:
        return field.sdf((centers[:, None] + offsets).reshape(-1, 3)).reshape(len(centers), len(offsets))
    values: Float = around(centers, offsets)
    return values


# A mesh with its vertices on a surface is farthest from it at the centres of faces and the midpoints of edges.


def face_sample_points(corners: Float) -> Float:
    """Return the centres and then the sides' midpoints, of shape (4 F, 3), of faces given by corners of (F, 3, 3)."""
    midpoints = (corners + np.roll(corners, -1, axis=1)) / 2
    return np.concatenate([corners.mean(axis=1), midpoints.reshape(-1, 3)])
