"""Measuring a mesh against a reference.

Samples are drawn on each surface, uniformly by area, and measured against the other surface itself, as distances from
point to triangle. A reference without faces is measured as it is: its own points take the samples' place, and the way
back goes to its nearest point, which on average cannot be smaller than a share of its spacing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from gnrecon.export.definitions import Metrics
from gnrecon.export.nearest import nearest_on_surface
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.runtime.errors import InputError, UsageError
from gnrecon.runtime.progress import Advance, unheard

F_SCORE_SHARE = 0.005
"""Threshold of the F-score as a share of the reference's radius."""


def measure(
    mesh: Mesh,
    reference: Mesh | PointCloud,
    samples: int = 100_000,
    seed: int = 0,
    scale: float | None = None,
    advance: Advance = unheard,
) -> Metrics:
    """Measure a mesh against the surface, or the cloud, that it should be.

    Parameters
    ----------
    mesh : Mesh
    reference : Mesh or PointCloud
        In the same frame and units.
    samples : int
        Samples on each surface.
    seed : int
        Of the sampling; equal seeds give equal numbers.
    scale : float, file units, optional
        What relative figures and the F-score's threshold refer to; by default the reference's radius, the largest
        distance of its vertices from their mean.
    advance : callable
        Told of the share that is done.

    Raises
    ------
    InputError
        When either has nothing to measure or coordinates that are not finite.
    UsageError
        When `samples` or `scale` is not positive, or the reference's points all coincide.
    """
    if samples < 1:
        raise UsageError(f"The number of samples is {samples}, but must be at least 1.")
    if not len(mesh.faces):
        raise InputError("The mesh has no faces, so there is nothing to measure.")
    anchor = reference.vertices if isinstance(reference, Mesh) else reference.points
    if not len(anchor) or (isinstance(reference, Mesh) and not len(reference.faces)):
        raise InputError("The reference has neither faces nor points, so there is nothing to measure against.")
    for name, positions in (("mesh", mesh.vertices), ("reference", anchor)):
        if broken := int((~np.isfinite(positions)).any(axis=1).sum()):
            raise InputError(f"The {name} has {broken} points that are not finite, so distances cannot be measured.")
    radius = float(np.linalg.norm(anchor - anchor.mean(axis=0), axis=1).max()) if scale is None else scale
    if not radius > 0:
        raise UsageError(f"Distances cannot be given relative to a scale of {radius}, which is not positive.")
    rng = np.random.default_rng(seed)
    on_mesh = sample_surface(mesh, samples, rng)
    if isinstance(reference, Mesh):
        on_reference = sample_surface(reference, samples, rng)
        back = _to_surface(on_mesh, reference)
    else:
        on_reference = _samples_of_cloud(reference)
        back = _to_points(on_mesh, on_reference)
    advance(0.5)
    there = _to_surface(on_reference, mesh)
    advance(1.0)
    return _summary(there, back, radius, samples, isinstance(reference, PointCloud))


@dataclass(frozen=True)
class Samples:
    """Points of shape (N, 3), in file units, with unit normals of the surface there, if it has any."""

    points: Float
    normals: Float | None


@dataclass(frozen=True)
class _Gap:
    """Distances of shape (N,) from samples to a target, and the mean |cosine| of the normals there."""

    distances: Float
    consistency: float | None


def sample_surface(mesh: Mesh, count: int, rng: np.random.Generator) -> Samples:
    """Draw `count` points on a mesh, uniformly by area, with the normals of their faces."""
    vectors = mesh.face_vectors
    areas = np.linalg.norm(vectors, axis=1)
    if not areas.sum() > 0:
        raise InputError("All faces of a mesh have zero area, so no points can be drawn on it.")
    faces = rng.choice(len(areas), size=count, p=areas / areas.sum())
    # The square root makes the density uniform over the triangle (Osada et al. 2002).
    root, along = np.sqrt(rng.random(count)), rng.random(count)
    weights = np.stack([1 - root, root * (1 - along), root * along], axis=1)
    points = np.einsum("ij,ijk->ik", weights, mesh.corners[faces])
    return Samples(points, vectors[faces] / areas[faces, None])


def _samples_of_cloud(cloud: PointCloud) -> Samples:
    if cloud.normals is None:
        return Samples(cloud.points, None)
    lengths = np.maximum(np.linalg.norm(cloud.normals, axis=1, keepdims=True), np.finfo(np.float64).tiny)
    return Samples(cloud.points, cloud.normals / lengths)


def _to_surface(samples: Samples, mesh: Mesh) -> _Gap:
    distances, faces = nearest_on_surface(mesh, samples.points)
    vectors = mesh.face_vectors[faces]
    lengths = np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), np.finfo(np.float64).tiny)
    return _Gap(distances, _consistency(samples.normals, vectors / lengths))


def _to_points(samples: Samples, target: Samples) -> _Gap:
    distances, rows = cKDTree(target.points).query(samples.points)
    normals = None if target.normals is None else target.normals[rows]
    return _Gap(distances, _consistency(samples.normals, normals))


def _consistency(ours: Float | None, theirs: Float | None) -> float | None:
    if ours is None or theirs is None:
        return None
    return float(np.abs(np.einsum("ij,ij->i", ours, theirs)).mean())


def _summary(there: _Gap, back: _Gap, radius: float, samples: int, is_cloud: bool) -> Metrics:
    """Put the numbers together; `there` leads from the reference to the mesh, `back` the other way."""
    threshold = F_SCORE_SHARE * radius
    precision, recall = (float((gap.distances <= threshold).mean()) for gap in (back, there))
    total = precision + recall
    means = [float(gap.distances.mean()) for gap in (there, back)]
    rms = [float(np.sqrt(np.mean(gap.distances**2))) for gap in (there, back)]
    cosines = [gap.consistency for gap in (there, back) if gap.consistency is not None]
    return Metrics(
        reference_to_mesh_mean=means[0],
        mesh_to_reference_mean=means[1],
        chamfer_mean=sum(means) / 2,
        reference_to_mesh_rms=rms[0],
        mesh_to_reference_rms=rms[1],
        chamfer_rms_paper=rms[0],
        hausdorff=float(max(there.distances.max(), back.distances.max())),
        normal_consistency=sum(cosines) / 2 if len(cosines) == 2 else None,
        precision=precision,
        recall=recall,
        f_score=2 * precision * recall / total if total else 0.0,
        threshold=threshold,
        radius=radius,
        samples=samples,
        reference_is_cloud=is_cloud,
    )
