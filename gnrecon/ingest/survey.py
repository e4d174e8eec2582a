"""What is in a cloud, and what would trouble a fit: extent, spacing, noise, normals, outliers and open borders.

Noise is the spread of neighbours about a quadric that is fitted to them, so that curvature is not taken for it. A point
lies at an open border where its neighbours, seen along the normal of their plane, leave a wide gap.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from gnrecon.cloud import Float, PointCloud
from gnrecon.ingest.normals import flip_if_inward
from gnrecon.ingest.outliers import find_outliers

_MOST = 10_000
"""Points that neighbourhoods are measured at; more would change no figure."""

_NEIGHBOURS = 24
_GAP = np.radians(120)
_QUADRIC = 6
_OPEN_SHARE = 0.01
_UNIT = 0.05
_DISAGREEING = 0.02


@dataclass(frozen=True)
class Survey:
    """Facts of a cloud; lengths in file units.

    Parameters
    ----------
    points, non_finite, duplicates, outliers : numbers of points; outliers among the others, of `_MOST` at most
    lower, upper : corners of the box
    spacing, spacing_p5, spacing_p95 : median distance to the nearest point, and what 5 % and 95 % stay below
    noise : standard deviation along the normal
    normals : ``"missing"``, ``"zero"``, ``"unnormalised"``, ``"inconsistent"``, ``"inward"`` or ``"good"``
    border_share : share of the points at an open border
    open : whether these are more than chance makes
    origins : different positions of the scanner; 0 where they are not known
    """

    points: int
    non_finite: int
    duplicates: int
    outliers: int
    lower: list[float]
    upper: list[float]
    spacing: float
    spacing_p5: float
    spacing_p95: float
    noise: float
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
    chosen = np.random.default_rng(0).permutation(len(rows))[:_MOST]
    centred = points - points.mean(axis=0)
    nearest, noise = _fine(centred, chosen)
    thinned = centred[chosen]
    border = _border_share(thinned)
    origins = 0 if cloud.origins is None else len(np.unique(cloud.origins, axis=0))
    return Survey(
        len(cloud),
        int((~finite).sum()),
        int(finite.sum()) - len(points),
        int(find_outliers(thinned).sum()),
        points.min(axis=0).tolist(),
        points.max(axis=0).tolist(),
        float(np.median(nearest)),
        float(np.percentile(nearest, 5)),
        float(np.percentile(nearest, 95)),
        noise,
        "missing" if cloud.normals is None else _state(thinned, cloud.normals[rows[chosen]]),
        border,
        border > _OPEN_SHARE,
        origins,
    )


def _fine(points: Float, chosen: np.ndarray[Any, np.dtype[np.intp]]) -> tuple[Float, float]:
    """Distances to the nearest point, at the chosen ones, and the noise."""
    from scipy.spatial import cKDTree

    distances, rows = cKDTree(points).query(points[chosen], _NEIGHBOURS + 1)
    u, v, w = np.moveaxis(_local(points[rows]), 2, 0)
    columns = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=2)
    rest = w - np.einsum("gkc,gc->gk", columns, np.einsum("gck,gk->gc", np.linalg.pinv(columns), w))
    variance = (rest**2).sum(axis=1) / (rest.shape[1] - _QUADRIC)
    scale = distances[:, -1]
    return distances[:, 1], float(np.sqrt(np.median(variance * scale**2)))


def _local(groups: Float) -> Float:
    """Neighbourhoods, of shape (G, k, 3), in units of their reach: two axes in their plane, one along its normal."""
    centred = groups - groups[:, :1]
    centred = centred / np.linalg.norm(centred, axis=2).max(axis=1)[:, None, None]
    spread = centred - centred.mean(axis=1, keepdims=True)
    axes = np.linalg.eigh(np.einsum("gki,gkj->gij", spread, spread))[1][:, :, ::-1]
    local: Float = np.einsum("gki,gij->gkj", centred, axes)
    return local


def _border_share(points: Float) -> float:
    from scipy.spatial import cKDTree

    rows = cKDTree(points).query(points, min(_NEIGHBOURS + 1, len(points)))[1]
    local = _local(points[rows])[:, 1:]
    angles = np.sort(np.arctan2(local[:, :, 1], local[:, :, 0]), axis=1)
    gaps = np.diff(angles, axis=1, append=angles[:, :1] + 2 * np.pi)
    return float((gaps.max(axis=1) > _GAP).mean())


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
