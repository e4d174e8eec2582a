"""Spreads samples over the planes and cylinders of a clean scan, up to where they meet.

Sparse points leave gaps at edges and above all at corners, where a sum of smooth features is unconstrained. Where they
lie on planes and cylinders, these determine the surface far better than any two neighbours do. So each primitive is
covered with even samples around its own points, and of these are dropped:

- those that the nearest of its points reaches only through another face, that is through the plane of a point nearby
  that is not on the same primitive;
- those with the same winding number of all samples on both sides. It is one half on a closed surface, and zero or one
  on what extends beyond an edge;
- of those far from the points, those with no neighbour on some side, and so on from there: they close no gap.

Entry: `resample_primitives`.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import cKDTree

from gnrecon.fit.shape_priors.face_sampling import FaceSampler, FaceSamples, crosses_face
from gnrecon.fit.shape_priors.primitives import Cylinder, Plane, cosine_of, is_inlier
from gnrecon.fit.shape_priors.prior_parameters import ResamplingParameters
from gnrecon.fit.shape_priors.snapping import FaceSearch, PrimitiveFace
from gnrecon.geometry.arrays import Float, Int, Mask
from gnrecon.geometry.signed_distance import Density, winding_number


def resample_primitives(
    points: Float, normals: Float, parameters: ResamplingParameters = ResamplingParameters()
) -> tuple[Float, Float]:
    """Return samples and unit normals, both of shape (M, 3), of the planes and cylinders that points lie on.

    Parameters
    ----------
    points, normals : arrays of shape (N, 3), unit normals
    parameters : of the resampling
    """
    p, nothing = parameters, (np.zeros((0, 3)), np.zeros((0, 3)))
    if len(points) >= p.max_points:
        return nothing
    density = Density(points)
    search = FaceSearch(density, p.noise_radii * density.radius, np.random.default_rng(0))
    found = _with_small_planes(search, normals, search.detect(points, normals, p.angle_degrees, []), p)
    found = [face for face in found if isinstance(face.surface, Plane | Cylinder)]
    if not found:
        return nothing
    count = min(max(p.target_samples, len(points)), p.max_samples_per_point * len(points))
    spacing = float(np.sqrt(np.pi * np.square(density.disks).sum() / count))
    sampler = FaceSampler(density, normals, found, search.parameters.detection.min_points, p)
    faces = [sampler.samples(number, spacing) for number in range(len(found))]
    samples, sample_normals = (
        np.concatenate(parts) for parts in zip(*((one.x, one.normals) for one in faces), strict=True)
    )
    rest = search.left(found)
    areas = np.concatenate([np.full(len(one.x), one.grid.area) for one in faces])
    others = areas, points[rest], normals[rest], density.disks[rest]
    reach = p.neighbour_spacings * spacing
    kept: Mask = np.ones(len(samples), dtype=bool)
    for _ in range(p.passes):
        kept = _without_open_sides(faces, _two_sided(kept, samples, sample_normals, *others), samples, points, reach)
    kept &= ~_beyond_edges(faces, kept, samples, sample_normals, reach)
    kept &= np.concatenate([one.apart for one in faces])
    return samples[kept], sample_normals[kept]


def _face_numbers(faces: list[FaceSamples]) -> Int:
    """Return the number of each sample's face, of shape (M,)."""
    return np.repeat(np.arange(len(faces)), [len(one.x) for one in faces])


def _beyond_edges(faces: list[FaceSamples], kept: Mask, x: Float, normals: Float, reach: float) -> Mask:
    """Return which samples lie beyond an edge up to which both of its faces are covered, of shape (M,).

    Parameters
    ----------
    faces : the samples of each
    kept : mask of shape (M,), of their samples, in order
    x, normals : arrays of shape (M, 3), the samples
    reach : of the piece of a face around a sample that ways cannot cross
    """
    face = _face_numbers(faces)
    found = [
        crosses_face(one.x, one.start, x[other], normals[other], np.full(int(other.sum()), reach))
        for number, one in enumerate(faces)
        for other in [kept & (face != number)]
    ]
    return np.concatenate(found)


def _without_open_sides(
    faces: list[FaceSamples],
    kept: Mask,
    x: Float,
    points: Float,
    reach: float,
    *,
    max_rounds: int = 30,
    neighbours: int = 6,
) -> Mask:
    """Return which samples stay when those far from points are removed, from the rim on, where a side is open.

    Parameters
    ----------
    faces : the samples of each
    kept : mask of shape (M,), of their samples, in order
    x : array of shape (M, 3), the samples
    points : array of shape (N, 3), that were scanned
    reach : to a sample of another face, or a point, that closes a side
    max_rounds : of removal, each of one ring of samples
    neighbours : of the place at a side, among which another face's sample is looked for
    """
    ends = np.cumsum([0, *(len(one.x) for one in faces)])
    face, kept = _face_numbers(faces), kept.copy()
    sides = [one.sides() for one in faces]
    for _ in range(max_rounds):
        before = int(kept.sum())
        rows = np.flatnonzero(kept)
        tree = cKDTree(np.concatenate([x[rows], points]))
        owner = np.concatenate([face[rows], np.full(len(points), -1)])
        for number, (one, (places, at)) in enumerate(zip(faces, sides, strict=True)):
            own = slice(ends[number], ends[number + 1])
            far = np.flatnonzero(kept[own] & ~one.sure)
            if not len(far):
                continue
            # A sample of the same face, by its number, which is -1 where there is none; or anything of another.
            closed = (at[far] >= 0) & kept[own][at[far]]
            away, near = tree.query(places[far], list(range(1, neighbours + 1)), distance_upper_bound=reach)
            known = np.isfinite(away)
            closed |= (known & (owner[np.where(known, near, 0)] != number)).any(axis=2)
            kept[ends[number] + far[~closed.all(axis=1)]] = False
        if int(kept.sum()) == before:
            break
    return kept


def _two_sided(
    kept: Mask,
    samples: Float,
    sample_normals: Float,
    areas: Float,
    rest: Float,
    normals: Float,
    disks: Float,
    *,
    rounds: int = 3,
    max_winding_offset: float = 0.3,
) -> Mask:
    """Return which of the samples kept have the inside on one side and the outside on the other, of shape (M,).

    On a closed surface the winding number is one half. What extends beyond an edge has the same on both sides.

    Parameters
    ----------
    kept : mask of shape (M,)
    samples, sample_normals : arrays of shape (M, 3)
    areas : array of shape (M,), that the samples stand for
    rest, normals : arrays of shape (K, 3), points that lie on no face, and their normals
    disks : array of shape (K,), radii of the disks that these stand for
    rounds : of removal, as removed samples no longer count
    max_winding_offset : of the winding number from one half
    """
    areas = np.concatenate([areas, np.pi * disks**2])
    sources, directions = np.concatenate([samples, rest]), np.concatenate([sample_normals, normals])
    dipoles, radii = directions * (areas / (4 * np.pi))[:, None], np.sqrt(areas / np.pi)

    def seen(at: Int, some: Int) -> Float:
        """Return the winding number of some sources at some samples."""
        return winding_number(samples[at], sources[some], dipoles[some], radii[some], torch.float32)

    at = np.flatnonzero(kept)
    winding = seen(at, np.concatenate([at, np.arange(len(samples), len(sources))]))
    for _ in range(rounds):
        stays = np.abs(winding - 0.5) < max_winding_offset
        gone, at, winding = at[~stays], at[stays], winding[stays]
        if not len(gone):
            break
        winding -= seen(at, gone)
    return np.isin(np.arange(len(samples)), at)


def _with_small_planes(
    search: FaceSearch, normals: Float, found: list[PrimitiveFace], parameters: ResamplingParameters
) -> list[PrimitiveFace]:
    """Return faces, and the planes of few points among the others, whose normals agree to a degree or two."""
    p, points, density = parameters, search.points, search.density
    left = search.left(found)
    if len(left) > p.max_plane_points:
        return found
    free = np.ones(len(left), dtype=bool)
    for at in range(len(left)):
        if not free[at]:
            continue
        plane = Plane(points[left[at]], normals[left[at]])
        rows = left[free & is_inlier(plane, points[left], normals[left], search.max_height, p.plane_degrees)]
        if len(rows) < p.min_plane_points:
            continue
        near = np.unique(np.concatenate(density.tree.query_ball_point(points[rows], p.reach_radii * density.radius)))
        cosine = normals[near.astype(np.int64)] @ plane.direction
        # A normal near it that differs a little shows that the plane is a piece of a bent surface.
        if ((cosine < cosine_of(2 * p.plane_degrees)) & (cosine > cosine_of(p.bent_degrees))).any():
            continue
        free &= ~np.isin(left, rows)
        found = [*found, PrimitiveFace(plane, rows)]
    return found
