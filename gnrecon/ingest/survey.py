"""What is in a cloud, and what would trouble a fit: extent, spacing, noise, normals, outliers and open borders.

A point lies at an open border where its neighbours, seen along the normal of their plane, leave a wide gap, and more
of its neighbours leave it too: by chance, or where a sheet is thin or bends sharply, one of both numbers may.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from gnrecon.geometry.arrays import Float
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.ingest.clusters import isolated_clusters
from gnrecon.ingest.noise import estimate_noise, local_frames
from gnrecon.ingest.normals import flip_if_inward
from gnrecon.ingest.outliers import find_outliers
from gnrecon.ingest.repeats import repeated_points

_MOST = 10_000
"""Points that neighbourhoods are measured at; more would change no figure."""

_NEIGHBOURS, _MORE_NEIGHBOURS = 24, 40
_DENSITY = 8  # neighbours that tell how densely points lie
_GAP = np.radians(120)
_OPEN_SHARE = 0.005
_UNIT = 0.05
_DISAGREEING = 0.02


@dataclass(frozen=True)
class Survey:
    """Facts of a cloud; lengths in file units.

    Parameters
    ----------
    points, non_finite, duplicates, repeated, clusters : numbers of points: all, those that are not finite, those at
        another's position, copies of others in a scan that is there twice, and those in isolated clusters
    outliers : among `_MOST` of the others
    lower, upper : corners of the box
    spacing, spacing_p5, spacing_p95 : median distance to the nearest point, and what 5 % and 95 % stay below
    density_variation : how many times as many points an area has where they lie densely (the 95th percentile) as where
        they lie thinly (the 5th)
    noise : standard deviation along the normal; 0 where there is none, None where it cannot be told
    noise_limit : what it is at most, because some of the spread may be the surface's own
    normals : ``"missing"``, ``"zero"``, ``"unnormalised"``, ``"inconsistent"``, ``"inward"`` or ``"good"``
    border_share : share of the points at an open border
    open : whether these are more than chance makes; not told where points are so few that noise is not either
    origins : different positions of the scanner; 0 where they are not known
    """

    points: int
    non_finite: int
    duplicates: int
    repeated: int
    outliers: int
    clusters: int
    lower: list[float]
    upper: list[float]
    spacing: float
    spacing_p5: float
    spacing_p95: float
    density_variation: float
    noise: float | None
    noise_limit: float
    normals: str
    border_share: float
    open: bool
    origins: int

    def as_dict(self) -> dict[str, Any]:
        """Return the facts by name."""
        return asdict(self)


def survey(cloud: PointCloud) -> Survey | None:
    """Return the facts of a cloud, or None where fewer than 25 points are finite and distinct."""
    finite = np.isfinite(cloud.points).all(axis=1)
    points, first = np.unique(cloud.points[finite], axis=0, return_index=True)
    if len(points) <= _NEIGHBOURS:
        return None
    rows = np.flatnonzero(finite)[first]
    distinct, repeated = len(points), repeated_points(points - points.mean(axis=0))
    points, rows = points[~repeated], rows[~repeated]
    chosen = np.random.default_rng(0).permutation(len(rows))[:_MOST]
    centred = points - points.mean(axis=0)
    nearest, area = _spacings(centred, chosen)
    thinned, spacing = centred[chosen], float(np.median(nearest))
    noise = estimate_noise(centred, spacing)
    border = _border_share(thinned)
    return Survey(
        points=len(cloud),
        non_finite=int((~finite).sum()),
        duplicates=int(finite.sum()) - distinct,
        repeated=int(repeated.sum()),
        outliers=int(find_outliers(thinned).sum()),
        clusters=int(isolated_clusters(centred).sum()),
        lower=points.min(axis=0).tolist(),
        upper=points.max(axis=0).tolist(),
        spacing=spacing,
        spacing_p5=float(np.percentile(nearest, 5)),
        spacing_p95=float(np.percentile(nearest, 95)),
        density_variation=float(np.percentile(area, 95) / np.percentile(area, 5)),
        noise=noise.deviation,
        noise_limit=noise.limit,
        normals="missing" if cloud.normals is None else _state(thinned, cloud.normals[rows[chosen]]),
        border_share=border,
        open=border > _OPEN_SHARE and noise.deviation is not None,
        origins=0 if cloud.origins is None else len(np.unique(cloud.origins, axis=0)),
    )


def _spacings(points: Float, chosen: np.ndarray[Any, np.dtype[np.intp]]) -> tuple[Float, Float]:
    """Distances to the nearest point, and the areas that hold as many points each, at the chosen ones."""
    from scipy.spatial import cKDTree

    distances = cKDTree(points).query(points[chosen], _DENSITY + 1)[0]
    return distances[:, 1], distances[:, -1] ** 2


def _border_share(points: Float) -> float:
    from scipy.spatial import cKDTree

    rows = cKDTree(points).query(points, min(_MORE_NEIGHBOURS + 1, len(points)))[1]
    at_border = np.ones(len(points), bool)
    for count in (_NEIGHBOURS, _MORE_NEIGHBOURS):
        local = local_frames(points[rows[:, : count + 1]])[:, 1:]
        angles = np.sort(np.arctan2(local[:, :, 1], local[:, :, 0]), axis=1)
        at_border &= np.diff(angles, axis=1, append=angles[:, :1] + 2 * np.pi).max(axis=1) > _GAP
    return float(at_border.mean())


def _state(points: Float, normals: Float) -> str:
    """What is to be said of the normals first."""
    from scipy.spatial import cKDTree

    lengths = np.linalg.norm(normals, axis=1)
    usable = np.isfinite(lengths) & (lengths > 0)
    if 2 * usable.sum() < len(normals):
        return "zero"
    points, directions = points[usable], normals[usable] / lengths[usable, None]
    rows = cKDTree(points).query(points, min(9, len(points)))[1][:, 1:]
    agreeing = np.einsum("gki,gi->gk", directions[rows], directions) > 0
    if (agreeing.mean(axis=1) < 0.5).mean() > _DISAGREEING:
        return "inconsistent"
    if flip_if_inward(points, directions)[1]:
        return "inward"
    return "good" if (np.abs(lengths[usable] - 1) < _UNIT).all() else "unnormalised"
