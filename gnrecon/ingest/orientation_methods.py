"""Methods that sign normals outward: propagation, lines of sight, winding numbers, Gauss's theorem."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from gnrecon.geometry.arrays import Float, Int, Mask
from gnrecon.ingest.point_spacing import mean_distances
from gnrecon.runtime.chunks import slices
from gnrecon.runtime.errors import InputError
from gnrecon.runtime.quiet_imports import import_open3d


def propagate_orientation(
    points: Float,
    directions: Float,
    planes: Float,
    penalty: float,
    *,
    neighbours: int = 8,
    jitter_extents: float = 1e-6,
) -> Float:
    """Return `directions` with signs propagated along a minimum spanning tree of nearly parallel tangent planes.

    The signs as a whole are those of `with_outside`. Source: Hoppe et al., *Surface Reconstruction from Unorganized
    Points* (1992), in open3d's implementation. It fails at thin walls and in sparse regions.

    Parameters
    ----------
    points, directions, planes : arrays of shape (N, 3); points centred and distinct
    penalty : weight against edges of the tree that leave the tangent plane, as where two sheets come close
    neighbours : of each point in the graph
    jitter_extents : by which points are moved, in extents of the cloud: the tree comes from a Delaunay triangulation,
        which fails for exactly cospherical points

    Raises
    ------
    InputError
        When the points cannot be triangulated, for example fewer than four.
    """
    open3d = import_open3d()

    jitter = jitter_extents * np.abs(points).max() * np.random.default_rng(0).normal(size=points.shape)
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points + jitter))
    cloud.normals = open3d.utility.Vector3dVector(planes)
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        try:
            cloud.orient_normals_consistent_tangent_plane(min(neighbours, len(points) - 1), penalty, 1.0)
        except RuntimeError:  # from open3d, for points that cannot be triangulated
            raise InputError(f"Normals cannot be estimated from {len(points)} points that span no volume.") from None
    signs = np.where(np.einsum("ij,ij->i", directions, np.asarray(cloud.normals)) < 0, -1.0, 1.0)
    return with_outside(points, directions * signs[:, None])


def is_open(side: float, *, most: float = 0.3) -> bool:
    """Return whether an `outwardness` is that of an open surface, without an inside.

    Half a sphere has 0.6, sheets and scenes on the ground have less than 0.2; the signs of random ones have 0, too.
    """
    return abs(side) < most


def with_outside(points: Float, normals: Float, *, gap_spacings: float = 2.0, least_part_points: int = 50) -> Float:
    """Return consistent normals with the signs that the surface as a whole shows: outward, or upward if it is open.

    The tree of a propagation jumps from one part of a scene to the next where nothing says which sides belong together,
    as from the ground to an object whose underside was not seen. So each part gets its own sign.

    Parameters
    ----------
    points, normals : arrays of shape (N, 3)
    gap_spacings : parts are farther apart than this, in the median distance to the eighth neighbour
    least_part_points : a part with fewer keeps its sign, because its own winding number says little
    """
    normals = _turned_outside(points, normals)
    parts = _parts(points, gap_spacings)
    if parts.any():
        for part in np.flatnonzero(np.bincount(parts) >= least_part_points):
            rows = parts == part
            normals[rows] = _turned_outside(points[rows] - points[rows].mean(axis=0), normals[rows])
    return normals


def _turned_outside(points: Float, normals: Float) -> Float:
    """Return the normals of one surface, all or none turned around."""
    side = outwardness(points, normals)
    if is_open(side):
        side = float(normals[:, 2].mean())
    return -normals if side < 0 else normals


def _parts(points: Float, gap_spacings: float, *, neighbours: int = 8) -> Int:
    """Return the number, from 0, of the part that each point is in, of shape (N,)."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    count = min(neighbours, len(points) - 1)
    distances, near = cKDTree(points).query(points, count + 1)
    first, column = np.nonzero(distances < gap_spacings * np.median(distances[:, -1]))
    links = coo_matrix((np.ones(len(first), np.int8), (first, near[first, column])), shape=(len(points),) * 2)
    parts: Int = connected_components(links, directed=False)[1].astype(np.intp)
    return parts


def orient_towards_scanner(
    points: Float,
    directions: Float,
    origins: Float | None,
    *,
    grazing_degrees: float = 10.0,
    least_known_share: float = 0.5,
) -> tuple[Float, float] | None:
    """Return the directions signed towards the scanner, and the share of points where the line of sight decides.

    The side of a surface that was seen is its outside. Where the line of sight grazes the estimated plane, a small
    error of the plane would decide the sign, and where a point's origin is unknown there is no line of sight. These
    points follow the mean normal of the nearest points that are decided.

    Parameters
    ----------
    points, directions : arrays of shape (N, 3); directions of unit length
    origins : array of shape (N, 3), rows of NaN where they are unknown; or None
    grazing_degrees : angle between line of sight and plane below which it does not decide, about the error of a normal
    least_known_share : of points with a known origin, for the others to follow them

    Returns
    -------
    Normals of shape (N, 3) and a share, or None where too few origins are known.
    """
    if origins is None:
        return None
    # Damaged origins may be any numbers; where lengths overflow, the line of sight does not decide.
    with np.errstate(over="ignore", invalid="ignore"):
        sight = origins - points
        lengths = np.linalg.norm(sight, axis=1)
        cosines = np.einsum("ij,ij->i", directions, sight) / np.maximum(lengths, np.finfo(np.float64).tiny)
    known = np.isfinite(cosines) & (lengths > 0)
    decided = known & (np.abs(cosines) >= float(np.sin(np.radians(grazing_degrees))))
    if known.mean() < least_known_share or not decided.any():
        return None
    normals: Float = directions * np.where(cosines < 0, -1.0, 1.0)[:, None]
    return _follow_decided(points, normals, decided), float(decided.mean())


def _follow_decided(points: Float, normals: Float, decided: Mask, *, neighbours: int = 8) -> Float:
    """Return the normals; undecided ones get the sign of the mean of the nearest decided ones."""
    from scipy.spatial import cKDTree

    count = min(neighbours, int(decided.sum()))
    near = cKDTree(points[decided]).query(points[~decided], list(range(1, count + 1)))[1]
    mean = normals[decided][near].sum(axis=1)
    result = normals.copy()
    result[~decided] *= np.where(np.einsum("ij,ij->i", normals[~decided], mean) < 0, -1.0, 1.0)[:, None]
    return result


# The winding number as a measure of how outward oriented points are.
#
# By Gauss's theorem the flux w(q) = sum_j a_j n_j . (p_j - q) / (4 pi |p_j - q|^3), with a_j the area of point j, is 1
# inside and 0 outside of a closed surface with outward normals, and 1/2 on it when the singular term of the point
# itself is left out. Inward normals give -1/2, a flat sheet 0, half of a sphere 1/4. So the sign of the median of w
# separates outward from inward, and it is near 1/2 in magnitude only for a nearly closed surface.


def winding_at_points(
    points: Float,
    normals: Float,
    *,
    max_sources: int = 4000,
    max_queries: int = 400,
    neighbours: int = 8,
    query_rows: int = 50,
) -> Float:
    """Return the principal value of the winding number at some of the points, of shape (Q,).

    Parameters
    ----------
    points : array of shape (N, 3), centred, all distinct, N > 1
    normals : array of shape (N, 3), of unit length
    max_sources : number of random points that the sum runs over, which bounds its cost
    max_queries : number of points at which it is evaluated; shares of them have an error of up to 2.5 %
    neighbours : that determine the area of a point
    query_rows : points that are evaluated together, whose terms fit into a processor's cache
    """
    from scipy.spatial import cKDTree

    rng = np.random.default_rng(0)
    chosen = rng.permutation(len(points))[:max_sources]
    sources, directions = points[chosen], normals[chosen]
    k = min(neighbours, len(sources) - 1)
    # k neighbours cover a disk up to the k-th of them.
    reach = cKDTree(sources).query(sources, k + 1)[0][:, -1]
    weighted = directions * (np.pi * reach**2 / k)[:, None]
    parts = [_flux(sources, weighted, sources[rows]) for rows in slices(min(max_queries, len(sources)), query_rows)]
    return np.concatenate(parts)


def _flux(sources: Float, weighted: Float, x: Float) -> Float:
    """Return sum_j w_j . (p_j - x) / (4 pi |p_j - x|^3) over all other points than x, of shape (Q,), at x."""
    # Axis by axis, as sums over an array's short last axis take several times as long.
    dx, dy, dz = (sources[:, axis] - x[:, axis, None] for axis in range(3))
    squares = dx * dx + dy * dy + dz * dz
    squares[squares == 0] = np.inf  # the term of the point itself
    flux = dx * weighted[:, 0] + dy * weighted[:, 1] + dz * weighted[:, 2]
    found: Float = (flux / (squares * np.sqrt(squares))).sum(axis=1) / (4 * np.pi)
    return found


def outwardness(points: Float, normals: Float) -> float:
    """Return 1 for a closed surface with outward normals, -1 with inward ones, and smaller magnitudes for open ones."""
    # The median, because where sheets nearly touch, single points are near the singularity of another.
    return 2 * float(np.median(winding_at_points(points, normals)))


def winding_disorder(points: Float, normals: Float) -> float:
    """Return the mean difference of the winding number from 1/2: near 0 only for consistent outward normals."""
    return float(np.minimum(np.abs(winding_at_points(points, normals) - 0.5), 1.0).mean())


def winding_agreement(points: Float, normals: Float) -> float:
    """Return the share of points, in [0, 1], whose winding number is nearer to 1/2 than to 0 and to 1."""
    return float((np.abs(winding_at_points(points, normals) - 0.5) < 0.25).mean())


Single = npt.NDArray[np.float32]


# Normals that agree with their own winding number, a refinement of `gauss_normals` that handles thin walls.
#
# The winding number w of area vectors mu_j changes fastest across the surface, so correct normals are along -grad w.
# Each round takes a step of steepest descent, with exact line search, towards w = 1/2 at all points, and then turns
# every mu_j to -grad w at its point. There are no neighbourhoods; each point smooths the kernel over its own width, as
# in `gauss_normals`. Source: Lin, Shi, Liu, *Fast and Globally Consistent Normal Orientation based on the Winding
# Number Normal Consistency* (ACM TOG 2024).


def consistent_normals(
    points: Float, normals: Float, *, width_spacings: float = 0.6, least_width: float = 1e-5, rounds: int = 10
) -> Float:
    """Return outward unit normals, of shape (N, 3).

    Parameters
    ----------
    points : array of shape (N, 3), distinct, samples of a closed surface; at most a few thousand
    normals : array of shape (N, 3), of unit length, a first guess, such as that of `gauss_normals`
    width_spacings : width of the kernel at a point, in mean distances to its neighbours; below 1, so that the other
        sheet of a thin wall is not smoothed away
    least_width : of the kernel, in extents of the cloud; squares of its values would overflow float32 below 1e-6
    rounds : number of iterations
    """
    scaled = points / np.abs(points).max()
    apart, count = mean_distances(scaled)
    widths = np.maximum(width_spacings * apart, least_width)
    field = _Winding(scaled.astype(np.float32), widths.astype(np.float32))
    mu = (normals * (np.pi / count * apart**2)[:, None]).astype(np.float32)
    # Where points lie so unevenly that single precision overflows, the first guess is kept.
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(rounds):
            downhill = field.transposed(0.5 - field.at_points(mu))
            change = field.at_points(downhill)
            mu = mu + np.float32(_square_sum(downhill) / max(_square_sum(change), 1e-30)) * downhill
            steepest = field.descent(mu)
            mu = np.linalg.norm(mu, axis=1, keepdims=True) * _unit(steepest)
    refined = mu.astype(np.float64)
    lengths = np.linalg.norm(refined, axis=1, keepdims=True)
    usable = np.isfinite(lengths) & (lengths > 0)
    return np.where(usable, np.where(usable, refined, 0.0) / np.where(usable, lengths, 1.0), normals)


def _square_sum(values: Single) -> float:
    """Return the sum of squares, which overflows single precision where points lie close together."""
    return float(np.square(values, dtype=np.float64).sum())


class _Winding:
    """w(p_i) = sum_j G_ij (p_j - p_i) . mu_j, with G_ij = 1 / (4 pi max(|p_j - p_i|, width_i)^3)."""

    def __init__(self, points: Single, widths: Single, *, chunk_rows: int = 256) -> None:
        from scipy.spatial.distance import cdist

        self._points = points
        self._kernel = np.empty((len(points), len(points)), np.float32)
        self._slope = np.empty_like(self._kernel)
        # Row by row, because distances in double precision and their powers would take five times the memory.
        for rows in slices(len(points), chunk_rows):
            distances = cdist(points[rows], points).astype(np.float32)
            bounded = np.maximum(distances, widths[rows, None])
            square = bounded * bounded
            self._kernel[rows] = 1 / (np.float32(4 * np.pi) * bounded * square)
            # Within the width the kernel is constant and its slope is zero.
            self._slope[rows] = np.where(distances < widths[rows, None], np.float32(0), 3 * self._kernel[rows] / square)

    def at_points(self, mu: Single) -> Single:
        """Return w, of shape (N,)."""
        p = self._points
        # In one array, so that one product passes over the matrix once.
        both: Single = np.column_stack([(p * mu).sum(axis=1), mu])
        sums = self._by_rows(lambda rows: self._kernel[rows] @ both)
        found: Single = sums[:, 0] - (p * sums[:, 1:]).sum(axis=1)
        return found

    def transposed(self, values: Single) -> Single:
        """Return the transpose of `at_points` times values of shape (N,): of shape (N, 3)."""
        p = self._points
        both: Single = np.column_stack([values, p * values[:, None]])
        sums = self._by_rows(lambda columns: self._kernel[:, columns].T @ both)
        found: Single = p * sums[:, :1] - sums[:, 1:]
        return found

    def descent(self, mu: Single) -> Single:
        """Return -grad w at the points, of shape (N, 3)."""
        p = self._points
        height, both = (p * mu).sum(axis=1), np.column_stack([np.ones(len(p), np.float32), p])

        def of_rows(rows: slice) -> Single:
            along: Single = p[rows] @ mu.T
            np.subtract(height, along, out=along)
            along *= self._slope[rows]
            sums: Single = along @ both
            found: Single = self._kernel[rows] @ mu - (sums[:, 1:] - p[rows] * sums[:, :1])
            return found

        return self._by_rows(of_rows)

    def _by_rows(self, work: Callable[[slice], Single], *, chunk_rows: int = 256) -> Single:
        """Return what a function makes of some rows at a time, which stay in the processor's cache, in threads."""
        from gnrecon.runtime.parallel import map_in_threads  # it loads torch

        return np.concatenate(map_in_threads(work, slices(len(self._points), chunk_rows)))


def _unit(vectors: Single) -> Single:
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    found: Single = vectors / np.maximum(lengths, np.float32(1e-30))
    return found


# Outward normals of a sparse closed cloud from Gauss's theorem alone, without neighbourhoods.
#
# Lin, Xiao, Shi, Wang, *Surface Reconstruction from Point Clouds without Normals by Parametrizing the Gauss Formula*
# (ACM TOG 2022). The unknown area vectors mu_j = a_j n_j must make the winding number 1/2 at every point,
#
#     sum_j K(p_i, p_j) . mu_j = 1/2,     K(q, p) = (p - q) / (4 pi max(|p - q|, width_q)^3),
#
# that is A mu = 1/2 with A of shape (N, 3N). Its least-norm solution is mu = A^T xi with A A^T xi = 1/2, where the
# diagonal of A A^T is multiplied by alpha > 1 as regularisation. The system is global, so thin walls and sparse regions
# are oriented correctly where neighbouring tangent planes are not informative. It is dense, so N must not exceed a few
# thousand.


def gauss_normals(points: Float, *, regularisation: float = 2.0, least_width: float = 1e-9) -> Float:
    """Return outward unit normals, of shape (N, 3).

    Parameters
    ----------
    points : array of shape (N, 3), distinct, samples of a closed surface
    regularisation : alpha, the factor of the system's diagonal
    least_width : of the kernel, in extents of the cloud, for points that doubles can hardly tell apart
    """
    from scipy.linalg import cho_factor, cho_solve

    points = points / np.abs(points).max()
    width = np.maximum(mean_distances(points)[0], least_width)
    offsets = points[None, :, :] - points[:, None, :]
    distances = np.maximum(np.linalg.norm(offsets, axis=2), width[:, None])
    A = (offsets / (4 * np.pi * distances**3)[:, :, None]).reshape(len(points), -1)
    gram = A @ A.T  # A A^T, of shape (N, N)
    gram[np.diag_indices(len(points))] *= regularisation
    xi = cho_solve(cho_factor(gram, overwrite_a=True), np.full(len(points), 0.5))
    mu = (A.T @ xi).reshape(-1, 3)  # least-norm area vectors
    normals: Float = mu / np.maximum(np.linalg.norm(mu, axis=1, keepdims=True), np.finfo(np.float64).tiny)
    return normals
