"""What is in a cloud, and what would trouble a fit: extent, spacing, noise, normals, outliers and open borders.

A point lies at an open border where its neighbours, seen along the normal of their plane, leave a wide gap, and more
of its neighbours leave it too: by chance, or where a sheet is thin or bends sharply, one of both numbers may.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gnrecon.geometry.arrays import Float, Mask
from gnrecon.geometry.local_pca import tangent_coordinates
from gnrecon.geometry.point_cloud import PointCloud, Samples
from gnrecon.ingest.clean import isolated_clusters, repeated_points
from gnrecon.ingest.noise import estimate_noise, neighbour_spacing
from gnrecon.ingest.orientation import flip_if_inward
from gnrecon.ingest.outliers import find_outliers

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
        local = tangent_coordinates(points[rows[:, : count + 1]])[:, 1:]
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


_TESTED = 500

_WIDTH, _HEIGHT = 3.0, 12.0
"""Radius and half height of a cylinder, in spacings of the points."""

_FACING = 0.5  # cosine

_LEAST = 24  # points that face one way, for a quadric twice

_TURNS = 6

_SEPARATION = 5.0
"""Offset over what remains: 2.7 for a normal distribution that is cut in two, 3.5 for a uniform one."""

_LEAST_OFFSET = 0.05
"""In spacings; what a quadric leaves over of an exact scan may look like two layers, far nearer to each other."""

_BALANCE = 0.2  # least share of a layer

_APART = 0.5  # of the layers' middles in the plane, in units of their spread

_BETWEEN = 0.1  # share of points that face the other way

_SHARE, _SHARE_UNSURE = 0.05, 0.15
"""Of the tested points, from which on layers are more than chance; the second where normals had to be estimated."""


# Double walls: two layers of points where there is one surface, as of scans that are not registered well.
#
# About a point, the points that face its way within a cylinder along its normal are described by a quadric, and by the
# same quadric twice, an offset apart, with each point on the nearer of the two (found by turns). Two layers are there
# where the offset is many times what remains about them, where both are about the same place in the tangent plane, so
# that neither a step nor an edge is taken for them, and where nothing between them faces the other way, as the back of
# a thin wall does: along a line, surfaces of a solid face this way and that way by turns.


@dataclass(frozen=True)
class Layers:
    """Two layers where there should be one.

    Parameters
    ----------
    share : of the points about which there are two
    offset : median distance between the layers, in the unit of the points
    """

    share: float
    offset: float

    def as_dict(self) -> dict[str, Any]:
        """Return the fields by name."""
        return asdict(self)

    def describe(self) -> str:
        """Return the finding as a sentence; lengths in file units."""
        return (
            f"At {self.share:.0%} of the points there are two layers, about {self.offset:.3g} file units apart: "
            f"scans seem not to be registered well."
        )


def layers_of(samples: Samples, normals: str) -> Layers | None:
    """Return how far apart layers of samples lie, in file units, or None where there are none.

    Parameters
    ----------
    samples : Samples
    normals : how theirs came about, as of `IngestCounts`; estimated ones may be wrong on the sides of thin walls
    """
    sure = normals in ("given", "given, flipped") or normals.endswith("origins")
    least = _SHARE if sure else _SHARE_UNSURE
    found = find_layers(samples.points, samples.normals, least)
    return None if found is None else Layers(found.share, found.offset * samples.frame.scale)


def find_layers(points: Float, normals: Float, least: float = _SHARE) -> Layers | None:
    """Return how far apart layers lie, or None where there are none.

    Parameters
    ----------
    points : array of shape (N, 3), centred, distinct
    normals : array of shape (N, 3), of unit length, oriented
    least : share of the points, from which on there are layers
    """
    from scipy.spatial import cKDTree

    if len(points) < 4 * _LEAST:
        return None
    tree, spacing = cKDTree(points), neighbour_spacing(points)
    chosen = np.random.default_rng(0).permutation(len(points))[:_TESTED]
    offsets = []
    for row in chosen:
        near = np.array(tree.query_ball_point(points[row], np.hypot(_WIDTH, _HEIGHT) * spacing))
        local = _in_cylinder(points[near] - points[row], normals[row], spacing)
        facing = normals[near] @ normals[row]
        offsets.append(_offset(local, facing))
    found = np.array([offset for offset in offsets if offset is not None])
    if len(found) < least * len(chosen):
        return None
    return Layers(len(found) / len(chosen), float(np.median(found)) * spacing)


def _in_cylinder(offsets: Float, normal: Float, spacing: float) -> Float:
    """Offsets, of shape (n, 3), as two coordinates in the tangent plane and one along the normal, in spacings.

    Those outside of the cylinder become NaN.
    """
    axes = np.linalg.svd(normal[None, :])[2]  # the normal, and two directions across it
    local: Float = offsets @ np.roll(axes, -1, axis=0).T / spacing
    local[:, 2] *= np.sign(axes[0] @ normal)
    outside = (np.hypot(local[:, 0], local[:, 1]) > _WIDTH) | (np.abs(local[:, 2]) > _HEIGHT)
    local[outside] = np.nan
    return local


def _offset(local: Float, facing: Float) -> float | None:
    """The distance between two layers of points, in spacings; None where there is only one."""
    inside = np.isfinite(local[:, 0])
    same = local[inside & (facing > _FACING)]
    if len(same) < _LEAST:
        return None
    upper, quadric, offset, remaining = _twice(same)
    balance = min(upper.mean(), 1 - upper.mean())
    least = max(_LEAST_OFFSET, _SEPARATION * remaining)
    if offset < least or balance < _BALANCE or not _mixed(same[:, :2], upper):
        return None
    back = local[inside & (facing < -_FACING)]
    heights = back[:, 2] - _columns(back) @ quadric
    between = int(((heights > 0) & (heights < offset)).sum())
    return offset if between < _BETWEEN * len(same) else None


def _twice(local: Float) -> tuple[Mask, Float, float, float]:
    """Fit a quadric twice: which points are on the upper one, the lower quadric, the offset, and what remains."""
    columns, heights = _columns(local), local[:, 2]
    rest = heights - columns @ np.linalg.lstsq(columns, heights, rcond=None)[0]
    upper = rest > (rest.min() + rest.max()) / 2
    for _ in range(_TURNS):
        both = np.column_stack([columns, upper])
        solution = np.linalg.lstsq(both, heights, rcond=None)[0]
        rest = heights - columns @ solution[:-1]
        turned = rest > solution[-1] / 2
        if (turned == upper).all() or turned.all() or not turned.any():
            break
        upper = turned
    remaining = np.sqrt(((rest - upper * solution[-1]) ** 2).sum() / (len(local) - both.shape[1]))
    return upper, solution[:-1], float(solution[-1]), float(remaining)


def _columns(local: Float) -> Float:
    u, v = local[:, 0], local[:, 1]
    return np.column_stack([np.ones_like(u), u, v, u * u, u * v, v * v])


def _mixed(plane: Float, upper: Mask) -> bool:
    """Whether both layers are about the same place in the plane."""
    spread = float(np.sqrt(plane.var(axis=0).sum()))
    return float(np.linalg.norm(plane[upper].mean(axis=0) - plane[~upper].mean(axis=0))) < _APART * spread


_METRES = {".e57": "E57", ".ptx": "PTX", ".gltf": "glTF", ".glb": "glTF", ".las": "LAS", ".laz": "LAZ"}

_FAR, _FAR_SHARE = 1e4, 30.0

_SIDE_TOLERANCE = 5e-3

_SMALLEST, _MIDDLE, _LARGEST = 0.005, 5.0, 5000.0


# Which unit a scan's coordinates may be in: a guess, with its reason, because few formats say it.
#
# E57, PTX and glTF are in metres by their definitions, and LAS nearly always is. Projected coordinates are metres too.
# Elsewhere only the size speaks: most things that are scanned are between a few millimetres and a few metres long.


@dataclass(frozen=True)
class UnitsGuess:
    """A unit, a name of `gnrecon.geometry.units.METRES` or None where there is nothing to go by, and why it is that."""

    unit: str | None
    reason: str

    def as_dict(self) -> dict[str, str | None]:
        """Return the fields by name."""
        return asdict(self)


def guess_units(lower: Sequence[float], upper: Sequence[float], files: Sequence[str] = ()) -> UnitsGuess:
    """Guess the unit of a scan.

    Parameters
    ----------
    lower, upper : corners of its box
    files : that it was read from
    """
    named = {_METRES.get(_extension(file)) for file in files}
    if len(named) == 1 and (name := named.pop()) is not None:
        usual = "usually" if name.startswith("LA") else "by definition"
        return UnitsGuess("m", f"{name} files are {usual} in metres")
    low, high = np.asarray(lower), np.asarray(upper)
    longest, place = float((high - low).max()), float(np.abs(low + high).max() / 2)
    if place > max(_FAR, _FAR_SHARE * longest):
        return UnitsGuess("m", f"coordinates about {place:,.0f} look like projected ones")
    if _normalised(low, high):
        return UnitsGuess(None, "the shape seems to have been scaled to a unit box or ball")
    if _SMALLEST < longest <= _MIDDLE:
        return UnitsGuess("m", f"its longest side, {longest:.3g}, would be {1000 * longest:,.4g} mm then")
    if _MIDDLE < longest <= _LARGEST:
        return UnitsGuess("mm", f"its longest side would be {longest:.4g} mm then, as of most things that are scanned")
    return UnitsGuess(None, f"its longest side, {longest:.3g}, is not like that of most things in mm or m")


def _extension(file: str) -> str:
    path = Path(file)
    return (path.with_suffix("") if path.suffix.lower() == ".gz" else path).suffix.lower()


def _normalised(low: Float, high: Float) -> bool:
    """Whether the box is one about the origin, or in its corner, that programs scale shapes to."""
    longest = float((high - low).max())
    centred = float(np.abs(low + high).max()) < 0.5 * longest
    sizes = [abs(longest - side) < _SIDE_TOLERANCE * side for side in (1.0, 2.0)]
    return any(sizes) and (centred or float(np.abs(low).max()) < _SIDE_TOLERANCE)
