"""Double walls: two layers of points where there is one surface, as of scans that are not registered well.

About a point, the points that face its way within a cylinder along its normal are described by a quadric, and by the
same quadric twice, an offset apart, with each point on the nearer of the two (found by turns). Two layers are there
where the offset is many times what remains about them, where both are about the same place in the tangent plane, so
that neither a step nor an edge is taken for them, and where nothing between them faces the other way, as the back of a
thin wall does: along a line, surfaces of a solid face this way and that way by turns.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from gnrecon.geometry.arrays import Float, Mask
from gnrecon.geometry.point_cloud import Samples
from gnrecon.ingest.spacing import neighbour_spacing

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
