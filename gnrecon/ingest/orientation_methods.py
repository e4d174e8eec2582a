"""Ways to find the outer side of a surface: propagation, lines of sight, winding numbers, Gauss's theorem."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from gnrecon.geometry.arrays import Float, Mask
from gnrecon.ingest.noise import mean_distances
from gnrecon.runtime.errors import InputError

_NEIGHBOURS = 8

_JITTER = 1e-6  # of the extent

_OPEN = 0.1  # outwardness, in size, that says nothing about inside and outside


# Signs of normals carried along a minimum spanning tree of nearly parallel tangent planes.
#
# Source: Hoppe et al., *Surface Reconstruction from Unorganized Points* (1992), as open3d has it, with a penalty of
# edges that leave the plane. Right for dense scans, open ones included; the sign of the whole is left open, and thin
# walls and sparse regions mislead it.
def propagate_orientation(points: Float, directions: Float, planes: Float, penalty: float) -> Float:
    """Return `directions` with signs propagated along `planes`, outward as a whole, or upward where it is open.

    Parameters
    ----------
    points, directions, planes : arrays of shape (N, 3); points centred and distinct
    penalty : weight against edges of the tree that leave the tangent plane, as where two sheets come close

    Raises
    ------
    InputError
        When the points cannot be triangulated, as fewer than four.
    """
    import open3d

    # The tree comes from a Delaunay triangulation, which fails for exactly cospherical points, so all are moved a bit.
    jitter = _JITTER * np.abs(points).max() * np.random.default_rng(0).normal(size=points.shape)
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points + jitter))
    cloud.normals = open3d.utility.Vector3dVector(planes)
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        try:
            cloud.orient_normals_consistent_tangent_plane(min(_NEIGHBOURS, len(points) - 1), penalty, 1.0)
        except RuntimeError:  # how open3d reports points that cannot be triangulated
            raise InputError(f"Normals cannot be estimated from {len(points)} points that span no volume.") from None
    signs = np.where(np.einsum("ij,ij->i", directions, np.asarray(cloud.normals)) < 0, -1.0, 1.0)
    normals: Float = directions * signs[:, None]
    side = outwardness(points, normals)
    if abs(side) < _OPEN:
        side = float(normals[:, 2].mean())
    return -normals if side < 0 else normals


_GRAZING = float(np.sin(np.radians(10.0)))

_KNOWN = 0.5
"""Share of the points whose origin must be known for the others to follow them."""


# Normals that look at the scanner: the side of a surface that was seen is its outside.
#
# Where the line of sight grazes the estimated plane, a small error of the plane would decide the side, and where a
# point's origin is not known nothing does. Such points follow the mean normal of the nearest ones that are decided.
def orient_towards_scanner(points: Float, directions: Float, origins: Float | None) -> tuple[Float, float] | None:
    """Return the directions with the signs that look at the scanner, and the share of points where sight decides.

    Parameters
    ----------
    points, directions : arrays of shape (N, 3); directions of unit length
    origins : array of shape (N, 3), rows of NaN where they are not known; or None

    Returns
    -------
    Normals of shape (N, 3) and a share, or None where too few origins are known.
    """
    if origins is None:
        return None
    sight = origins - points
    lengths = np.linalg.norm(sight, axis=1)
    with np.errstate(invalid="ignore"):
        cosines = np.einsum("ij,ij->i", directions, sight) / np.maximum(lengths, np.finfo(np.float64).tiny)
    known = np.isfinite(cosines) & (lengths > 0)
    decided = known & (np.abs(cosines) >= _GRAZING)
    if known.mean() < _KNOWN or not decided.any():
        return None
    normals: Float = directions * np.where(cosines < 0, -1.0, 1.0)[:, None]
    return _followed(points, normals, decided), float(decided.mean())


def _followed(points: Float, normals: Float, decided: Mask) -> Float:
    """Return the normals, those that are not decided with the sign of the nearest that are."""
    from scipy.spatial import cKDTree

    count = min(_NEIGHBOURS, int(decided.sum()))
    near = cKDTree(points[decided]).query(points[~decided], list(range(1, count + 1)))[1]
    mean = normals[decided][near].sum(axis=1)
    result = normals.copy()
    result[~decided] *= np.where(np.einsum("ij,ij->i", normals[~decided], mean) < 0, -1.0, 1.0)[:, None]
    return result


_SOURCES = 4000

_QUERIES = 400


# How outward a set of oriented points is, by their winding number.
#
# By Gauss's theorem the flux w(q) = sum_j a_j n_j . (p_j - q) / (4 pi |p_j - q|^3), with a_j the area that point j
# stands for, is 1 inside and 0 outside of a closed surface with outward normals, and 1/2 on it when the singular own
# term is left out. Inward normals give -1/2, a flat sheet 0, half of a sphere 1/4. So the median of 2 w over the points
# tells outward from inward and says how far the evidence goes: it is near 1 in size only for a surface that is nearly
# closed.
def winding_at_points(points: Float, normals: Float) -> Float:
    """Return the principal value of the winding number at some of the points, of shape (Q,).

    Parameters
    ----------
    points : array of shape (N, 3), centred, all distinct, N > 1
    normals : array of shape (N, 3), of unit length
    """
    from scipy.spatial import cKDTree

    rng = np.random.default_rng(0)
    chosen = rng.permutation(len(points))[:_SOURCES]
    sources, directions = points[chosen], normals[chosen]
    k = min(_NEIGHBOURS, len(sources) - 1)
    # k neighbours cover a disk that reaches the k-th of them.
    reach = cKDTree(sources).query(sources, k + 1)[0][:, -1]
    weighted = directions * (np.pi * reach**2 / k)[:, None]
    offsets = sources[None, :, :] - sources[:_QUERIES, None, :]
    cubes = np.linalg.norm(offsets, axis=2) ** 3
    cubes[cubes == 0] = np.inf  # a point's own term
    flux: Float = np.einsum("qjc,jc->qj", offsets, weighted)
    winding: Float = (flux / (4 * np.pi * cubes)).sum(axis=1)
    return winding


def outwardness(points: Float, normals: Float) -> float:
    """Return 1 for a closed surface with outward normals, -1 with inward ones, less in size the more it is open."""
    # The median, because where sheets nearly touch single points see each other's singularity.
    return 2 * float(np.median(winding_at_points(points, normals)))


def winding_disorder(points: Float, normals: Float) -> float:
    """Return the mean distance of the winding number from 1/2: near 0 only for a consistent outward orientation."""
    return float(np.minimum(np.abs(winding_at_points(points, normals) - 0.5), 1.0).mean())


def winding_agreement(points: Float, normals: Float) -> float:
    """Return the share of the points, in [0, 1], at which the winding number is nearer to 1/2 than to 0 and to 1."""
    return float((np.abs(winding_at_points(points, normals) - 0.5) < 0.25).mean())


Single = npt.NDArray[np.float32]

_WIDTH = 0.75
"""Of the kernel, in mean distances of a point to its nearest neighbours."""

_ROUNDS = 10


# Normals that agree with the winding number that they make: a refinement of those of `gauss`, thin walls included.
#
# The winding number w of area vectors mu_j changes fastest across the surface, so that the right normals are those of
# -grad w. Each round takes a step of steepest descent towards w = 1/2 at all points, with the exact length, and then
# turns every mu_j to -grad w at its point. Neighbourhoods play no part; each point smooths the kernel over its own
# width, as in `gauss`. Source: Lin, Shi, Liu, *Fast and Globally Consistent Normal Orientation based on the Winding
# Number Normal Consistency* (ACM TOG 2024).
def consistent_normals(points: Float, normals: Float) -> Float:
    """Return outward unit normals, of shape (N, 3).

    Parameters
    ----------
    points : array of shape (N, 3), distinct, samples of a closed surface; at most a few thousand
    normals : array of shape (N, 3), of unit length, a first guess, such as that of `gauss`
    """
    scaled = points / np.abs(points).max()
    apart, count = mean_distances(scaled)
    field = _Winding(scaled.astype(np.float32), (_WIDTH * apart).astype(np.float32))
    mu = (normals * (np.pi / count * apart**2)[:, None]).astype(np.float32)
    for _ in range(_ROUNDS):
        downhill = field.back(0.5 - field.at_points(mu))
        change = field.at_points(downhill)
        mu = mu + (downhill**2).sum() / max(float((change**2).sum()), 1e-30) * downhill
        steepest = field.descent(mu)
        mu = np.linalg.norm(mu, axis=1, keepdims=True) * _unit(steepest)
    refined = mu.astype(np.float64)
    return np.asarray(refined / np.linalg.norm(refined, axis=1, keepdims=True))


class _Winding:
    """w(p_i) = sum_j G_ij (p_j - p_i) . mu_j, with G_ij = 1 / (4 pi max(|p_j - p_i|, width_i)^3)."""

    def __init__(self, points: Single, widths: Single) -> None:
        from scipy.spatial.distance import cdist

        distances = cdist(points, points).astype(np.float32)
        bounded = np.maximum(distances, widths[:, None])
        self._points = points
        square = bounded * bounded
        self._kernel = 1 / (np.float32(4 * np.pi) * bounded * square)
        # Within the width the kernel is constant, so that there its slope adds nothing.
        self._slope = np.where(distances < widths[:, None], np.float32(0), 3 * self._kernel / square)

    def at_points(self, mu: Single) -> Single:
        """Return w, of shape (N,)."""
        p = self._points
        found: Single = self._kernel @ (p * mu).sum(axis=1) - (p * (self._kernel @ mu)).sum(axis=1)
        return found

    def back(self, values: Single) -> Single:
        """Return the transpose of `at_points` times values of shape (N,): of shape (N, 3)."""
        p = self._points
        found: Single = p * (self._kernel.T @ values)[:, None] - self._kernel.T @ (p * values[:, None])
        return found

    def descent(self, mu: Single) -> Single:
        """Return -grad w at the points, of shape (N, 3)."""
        p = self._points
        along = self._slope * ((p * mu).sum(axis=1)[None, :] - p @ mu.T)
        found: Single = self._kernel @ mu - (along @ p - p * along.sum(axis=1)[:, None])
        return found


def _unit(vectors: Single) -> Single:
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    found: Single = vectors / np.maximum(lengths, np.float32(1e-30))
    return found


_ALPHA = 2.0


# Outward normals of a sparse closed cloud from Gauss's theorem alone, without neighbourhoods.
#
# Lin, Xiao, Shi, Wang, *Surface Reconstruction from Point Clouds without Normals by Parametrizing the Gauss Formula*
# (ACM TOG 2022): the unknown area vectors mu_j = a_j n_j must make the winding number 1/2 at every point,
#
#     sum_j K(p_i, p_j) . mu_j = 1/2,     K(q, p) = (p - q) / (4 pi max(|p - q|, width_q)^3),
#
# that is A mu = 1/2 with A of shape (N, 3N). Its least-norm solution is mu = A^T xi with A A^T xi = 1/2, where the
# diagonal of A A^T is multiplied by alpha > 1 as regularisation. As the unknowns are global, thin walls and sparse
# regions where neighbouring tangent planes say nothing are oriented rightly. The price is a dense system, so N is to be
# at most a few thousand.
def gauss_normals(points: Float) -> Float:
    """Return outward unit normals, of shape (N, 3).

    Parameters
    ----------
    points : array of shape (N, 3), distinct, samples of a closed surface
    """
    from scipy.linalg import cho_factor, cho_solve

    width, _ = mean_distances(points)
    offsets = points[None, :, :] - points[:, None, :]
    distances = np.maximum(np.linalg.norm(offsets, axis=2), width[:, None])
    A = (offsets / (4 * np.pi * distances**3)[:, :, None]).reshape(len(points), -1)
    gram = A @ A.T  # A A^T, of shape (N, N)
    gram[np.diag_indices(len(points))] *= _ALPHA
    xi = cho_solve(cho_factor(gram, overwrite_a=True), np.full(len(points), 0.5))
    mu = (A.T @ xi).reshape(-1, 3)  # least-norm area vectors
    normals: Float = mu / np.maximum(np.linalg.norm(mu, axis=1, keepdims=True), np.finfo(np.float64).tiny)
    return normals
