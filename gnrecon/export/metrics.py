"""Measures a mesh against a reference: Chamfer and Hausdorff distances, F-score, normal consistency.

Samples are drawn on each surface, uniformly by area, and measured against the other surface itself, as distances from
point to triangle. A reference without faces is represented by its own points: the distance to the nearest of them is on
average at least a share of their spacing. The entries are `measure` and, for each vertex, `vertex_error`.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from gnrecon.export.boolean import centre_and_size
from gnrecon.export.mesh_statistics import concatenated
from gnrecon.geometry.arrays import Float, Int, Mask
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.runtime.chunks import slices
from gnrecon.runtime.errors import InputError, UsageError
from gnrecon.runtime.progress import ProgressCallback, ignore_progress
from gnrecon.runtime.quiet_imports import import_open3d


def measure(
    mesh: Mesh,
    reference: Mesh | PointCloud,
    samples: int = 100_000,
    seed: int = 0,
    scale: float | None = None,
    advance: ProgressCallback = ignore_progress,
    lid: Mesh | None = None,
) -> Metrics:
    """Measure a mesh against a reference surface or cloud.

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
        Unit of relative figures and of the F-score's threshold; by default the reference's radius, the largest
        distance of its vertices from their mean.
    advance : callable
        Receives the share that is done.
    lid : Mesh, optional
        Faces that close an open reference mesh, in its frame and units. A closed mesh has to cross the opening
        somewhere: its samples are measured to the nearer of reference and lid. No samples are drawn on the lid, so
        that a mesh may be open there.

    Raises
    ------
    InputError
        When either has nothing to measure or coordinates that are not finite, or the reference's points all coincide.
    UsageError
        When `samples` or `scale` is not positive, or the reference of a lid has no faces.
    """
    if samples < 1:
        raise UsageError(f"The number of samples is {samples}, but must be at least 1.")
    if not len(mesh.faces):
        raise InputError("The mesh has no faces, so there is nothing to measure.")
    anchor = reference.vertices if isinstance(reference, Mesh) else reference.points
    if not len(anchor) or (isinstance(reference, Mesh) and not len(reference.faces)):
        raise InputError("The reference has neither faces nor points, so there is nothing to measure against.")
    if lid is not None and not isinstance(reference, Mesh):
        raise UsageError("A lid was given for a reference without faces, but only a mesh can be closed.")
    covers = {} if lid is None else {"lid": lid.vertices}
    for name, positions in ({"mesh": mesh.vertices, "reference": anchor} | covers).items():
        if broken := int((~np.isfinite(positions)).any(axis=1).sum()):
            raise InputError(f"The {name} has {broken} points that are not finite, so distances cannot be measured.")
    radius = float(np.linalg.norm(anchor - anchor.mean(axis=0), axis=1).max()) if scale is None else scale
    if scale is None and not radius > 0:
        raise InputError("The reference has no extent: all of its points coincide.")
    if not radius > 0:
        raise UsageError(f"Distances cannot be given relative to a scale of {radius}, which is not positive.")
    # One generator for both, so that a seed determines all numbers.
    rng = np.random.default_rng(seed)
    on_mesh = sample_surface(mesh, samples, rng)
    if isinstance(reference, Mesh):
        on_reference = sample_surface(reference, samples, rng)
        back = _to_surface(on_mesh, reference if lid is None else concatenated([reference, lid]))
    else:
        on_reference = _samples_of_cloud(reference)
        back = _to_points(on_mesh, on_reference)
    advance(0.5)
    there = _to_surface(on_reference, mesh)
    advance(1.0)
    return _summary(there, back, radius, samples, isinstance(reference, PointCloud))


@dataclass(frozen=True)
class SurfaceSamples:
    """Points of shape (N, 3), in file units, with unit normals of the surface there, if it has any."""

    points: Float
    normals: Float | None


@dataclass(frozen=True)
class _Distances:
    """Distances of shape (N,) from samples to a target, and the mean |cosine| of the normals there."""

    distances: Float
    consistency: float | None


def sample_surface(mesh: Mesh, count: int, rng: np.random.Generator) -> SurfaceSamples:
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
    return SurfaceSamples(points, vectors[faces] / areas[faces, None])


def _samples_of_cloud(cloud: PointCloud) -> SurfaceSamples:
    if cloud.normals is None:
        return SurfaceSamples(cloud.points, None)
    lengths = np.maximum(np.linalg.norm(cloud.normals, axis=1, keepdims=True), np.finfo(np.float64).tiny)
    return SurfaceSamples(cloud.points, cloud.normals / lengths)


def _to_surface(samples: SurfaceSamples, mesh: Mesh) -> _Distances:
    distances, faces = nearest_on_surface(mesh, samples.points)
    vectors = mesh.face_vectors[faces]
    lengths = np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), np.finfo(np.float64).tiny)
    return _Distances(distances, _consistency(samples.normals, vectors / lengths))


def _to_points(samples: SurfaceSamples, target: SurfaceSamples) -> _Distances:
    distances, rows = cKDTree(target.points).query(samples.points)
    normals = None if target.normals is None else target.normals[rows]
    return _Distances(distances, _consistency(samples.normals, normals))


def _consistency(ours: Float | None, theirs: Float | None) -> float | None:
    if ours is None or theirs is None:
        return None
    # Absolute cosines, because references may be oriented either way.
    return float(np.abs(np.einsum("ij,ij->i", ours, theirs)).mean())


def _summary(
    there: _Distances,
    back: _Distances,
    radius: float,
    samples: int,
    is_cloud: bool,
    *,
    threshold_radii: float = 0.005,
) -> Metrics:
    """Compute the metrics from the distances of the reference's samples (`there`) and of the mesh's (`back`).

    `threshold_radii` is the F-score's threshold relative to the radius.
    """
    threshold = threshold_radii * radius
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


# Definitions are printed with the numbers, because the literature calls several of them "Chamfer": the mean or the root
# mean square, one way or both, squared or not.


@dataclass(frozen=True)
class Metrics:
    """Distances between a mesh and its reference, in file units unless said otherwise.

    Parameters
    ----------
    reference_to_mesh_mean, mesh_to_reference_mean : float
        Mean distance of the samples of one surface to the other surface.
    chamfer_mean : float
        Half the sum of the two means.
    reference_to_mesh_rms, mesh_to_reference_rms : float
        Root mean square distances.
    chamfer_rms_paper : float
        CD_1 of the paper's appendix "Chamfer Divergence": the root mean square distance from the reference to the mesh.
    hausdorff : float
        Largest distance of any sample to the other surface, both ways.
    normal_consistency : float or None
        Mean absolute cosine between a sample's normal and that of the nearest face, mean of both ways; None where the
        reference has neither faces nor normals.
    precision, recall, f_score : float
        Share of the mesh's samples within `threshold` of the reference, of the reference's within it of the mesh, and
        their harmonic mean.
    threshold : float
        Of the F-score.
    radius : float
        Largest distance of the reference's vertices from their mean, or the scale that was given instead.
    samples : int
        Samples on each surface that has faces.
    reference_is_cloud : bool
        Whether the reference has no faces, so that it is represented by its points.
    """

    reference_to_mesh_mean: float
    mesh_to_reference_mean: float
    chamfer_mean: float
    reference_to_mesh_rms: float
    mesh_to_reference_rms: float
    chamfer_rms_paper: float
    hausdorff: float
    normal_consistency: float | None
    precision: float
    recall: float
    f_score: float
    threshold: float
    radius: float
    samples: int
    reference_is_cloud: bool

    def as_dict(self) -> dict[str, object]:
        """All numbers by name, with the distances relative to the radius under ``relative``; ready for JSON."""
        return {**asdict(self), "relative": {name: getattr(self, name) / self.radius for name in DISTANCES}}

    def describe(self) -> list[str]:
        """One line a number: its value, the value relative to the radius, and its definition."""
        target = "nearest point" if self.reference_is_cloud else "surface"
        lines = [
            f"{name:24}{getattr(self, name):12.6g}{getattr(self, name) / self.radius:12.4e} of the radius  "
            f"{meaning.format(target=target)}"
            for name, meaning in DISTANCES.items()
        ]
        if self.normal_consistency is not None:
            meaning = "mean |cosine| of a sample's normal and the nearest one's, mean of both ways"
            lines.append(f"{'normal_consistency':24}{self.normal_consistency:12.6g}{'':26}{meaning}")
        meaning = f"harmonic mean of precision {self.precision:.4g} and recall {self.recall:.4g}"
        lines.append(f"{'f_score':24}{self.f_score:12.6g}{'':26}{meaning} within {self.threshold:.4g}")
        lines.append(f"{'radius':24}{self.radius:12.6g}{'':26}largest distance of a reference vertex from their mean")
        return lines


DISTANCES = {
    "reference_to_mesh_mean": "mean distance of the reference's samples to the mesh",
    "mesh_to_reference_mean": "mean distance of the mesh's samples to the reference's {target}",
    "chamfer_mean": "half the sum of the two means",
    "reference_to_mesh_rms": "root mean square distance of the reference's samples to the mesh",
    "mesh_to_reference_rms": "root mean square distance of the mesh's samples to the reference's {target}",
    "chamfer_rms_paper": "the paper's Chamfer divergence CD_1: the reference's root mean square distance to the mesh",
    "hausdorff": "largest of all distances, both ways",
}


def vertex_error(mesh: Mesh, reference: Mesh | PointCloud) -> Float:
    """Return the signed distance of each vertex to the nearest place of the reference, of shape (V,), in file units.

    The sign is that of (p - q) . n, with the vertex p, its foot q on the reference and the mesh's normal n. So it is
    positive outside of the reference, whether this is closed or open, a mesh or a cloud, and oriented or not.

    Parameters
    ----------
    mesh : Mesh
    reference : Mesh or PointCloud
        In the same frame and units; a cloud is represented by its points, so that the distance to it is at least a
        share of its spacing.
    """
    if isinstance(reference, Mesh):
        feet = SurfaceQuery(reference).nearest(mesh.vertices)[0]
    else:
        feet = reference.points[cKDTree(reference.points).query(mesh.vertices)[1]]
    away = mesh.vertices - feet
    outside = np.einsum("ij,ij->i", away, mesh.vertex_normals()) >= 0
    signed: Float = np.linalg.norm(away, axis=1) * np.where(outside, 1.0, -1.0)
    return signed


# Open3d's ray-casting tree uses float32. Positions are therefore centred and scaled to one first, and the foot point
# is computed again in float64 from the nearest triangle and its barycentric coordinates: a rounding of 1e-7 then shifts
# the foot along the triangle only, and changes the distance to second order.


def ray_scene(vertices: Float, faces: Int) -> Any:
    """open3d's tree over triangles, whose vertices of shape (V, 3) should be about one in size."""
    open3d = import_open3d()

    scene: Any = open3d.t.geometry.RaycastingScene()
    tensor = open3d.core.Tensor.from_numpy
    scene.add_triangles(tensor(vertices.astype(np.float32)), tensor(faces.astype(np.uint32)))
    return scene


class SurfaceQuery:
    """Nearest points of a mesh with faces, and inside tests.

    Parameters
    ----------
    mesh : Mesh
    batch : int
        Most points of a query at once.
    """

    def __init__(self, mesh: Mesh, batch: int = 1_000_000) -> None:
        self._centre, self._size = centre_and_size(mesh)
        self._scene = ray_scene((mesh.vertices - self._centre) / self._size, mesh.faces)
        self._corners, self._batch = mesh.corners, batch

    def nearest(self, points: Float) -> tuple[Float, Int]:
        """Return the nearest points of the surface, of shape (N, 3), and their faces, for points of shape (N, 3)."""
        feet = np.empty((len(points), 3))
        faces = np.empty(len(points), dtype=np.int64)
        for rows in slices(len(points), self._batch):
            answer = self._scene.compute_closest_points(self._queries(points[rows]))
            faces[rows] = answer["primitive_ids"].numpy()
            u, v = np.moveaxis(answer["primitive_uvs"].numpy().astype(np.float64), 1, 0)
            weights = np.stack([1 - u - v, u, v], axis=1)
            feet[rows] = np.einsum("ij,ijk->ik", weights, self._corners[faces[rows]])
        return feet, faces

    def inside(self, points: Float, *, rays: int = 5) -> Mask:
        """Return which points, of shape (N, 3), a closed surface encloses, to about 1e-7 of its size.

        The majority of `rays` decides: a single one may graze an edge and count it twice, or not at all.
        """
        inside = np.empty(len(points), dtype=bool)
        for rows in slices(len(points), self._batch):
            answer = self._scene.compute_occupancy(self._queries(points[rows]), nsamples=rays)
            inside[rows] = answer.numpy() > 0
        return inside

    def _queries(self, points: Float) -> Any:
        from open3d import core

        return core.Tensor.from_numpy(((points - self._centre) / self._size).astype(np.float32))


def nearest_on_surface(mesh: Mesh, points: Float, batch: int = 1_000_000) -> tuple[Float, Int]:
    """Distance to a surface, in its units, and the nearest face, for points of shape (N, 3)."""
    feet, faces = SurfaceQuery(mesh, batch).nearest(points)
    return np.linalg.norm(points - feet, axis=1), faces
