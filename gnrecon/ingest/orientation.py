"""Outward normals for clouds that come without, a check of those that come with some, and which of them are kept.

Directions come from neighbourhoods (`gnrecon.ingest.normals`); what is hard is their sign. Where the scanner's position
is known, the line of sight decides (`orient_towards_scanner`). Otherwise there are two ways:

- *propagation* along a spanning tree (`propagate_orientation`): right for dense scans, open ones included, but its
  overall sign is open, and thin walls and sparse regions mislead it;
- *Gauss's theorem* solved for all normals at once (`gauss_normals`), and normals that agree with the winding number
  that they make (`consistent_normals`): right for sparse closed clouds, thin walls included, and outward by
  construction; used on up to a few thousand points, from which the others take their sign.

The winding number of the result (`winding_on_surface`) decides between them, and says how far it can be trusted.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gnrecon.geometry.arrays import Float
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.ingest.normals import tangent_planes, unoriented_normals
from gnrecon.ingest.orientation_methods import (
    consistent_normals,
    gauss_normals,
    orient_towards_scanner,
    outwardness,
    propagate_orientation,
    winding_agreement,
    winding_disorder,
)
from gnrecon.runtime.errors import InputError, UsageError

_OFF_PLANE_PENALTY = 2.0

_LOCAL, _SMOOTH = 12, 24

_GAUSS_POINTS, _CONSISTENT_POINTS = 2000, 4000

_ORDERLY = 0.25  # disorder above which a closed surface's signs are doubtful in places, or the scan is open

_CLEARLY_BETTER = 0.8  # ratio of disorders that the winding number's ways must reach against propagation

_INWARD = -0.75  # half a sphere with inward normals has about -0.6, and may be the scan of a bowl

ESTIMATED, UNCERTAIN, BY_SIGHT = "estimated", "estimated, orientation uncertain", "estimated, oriented by origins"


@dataclass(frozen=True)
class Orientation:
    """Outward normals, and how they came about.

    Parameters
    ----------
    normals : array of shape (N, 3), of unit length
    how : such as ``"estimated"``; ``"estimated, orientation uncertain"`` where the winding number is far from that of a
        closed surface; ``"estimated, oriented by origins"``
    confidence : share in [0, 1] of the points that speak for their sign: the winding number there is that of a closed
        surface with outward normals, or, by origins, the line of sight is clear of the tangent plane; None for signs
        that were given
    flipped : share in [0, 1] of the given normals that were turned around
    """

    normals: Float
    how: str
    confidence: float | None = None
    flipped: float = 0.0

    @property
    def estimated(self) -> bool:
        """Whether at least the sides are estimates."""
        return self.confidence is not None


def oriented_normals(points: Float, origins: Float | None = None, along: Float | None = None) -> Orientation:
    """Estimate unit normals that point outward: to the scanner where it is known, for an open sheet mostly upward (+z).

    Parameters
    ----------
    points : array of shape (N, 3), distinct, N >= 10
    origins : array of shape (N, 3), optional
        Where the scanner stood; rows of NaN where that is not known.
    along : array of shape (N, 3), optional
        Unit normals of which only the signs are to be found.

    Raises
    ------
    InputError
        When the points cannot be triangulated, as fewer than four.
    """
    middle = points.mean(axis=0)
    centred = points - middle
    if len(points) <= 3:
        raise InputError(f"Normals cannot be estimated from {len(points)} points that span no volume.")
    axes = unoriented_normals(centred) if along is None else along
    seen = orient_towards_scanner(centred, axes, None if origins is None else origins - middle)
    if seen is not None:
        return Orientation(seen[0], BY_SIGHT, seen[1])
    normals, unrest = _by_shape(centred, axes, free=along is None)
    return Orientation(normals, ESTIMATED if unrest <= _ORDERLY else UNCERTAIN, winding_agreement(centred, normals))


def _by_shape(points: Float, axes: Float, free: bool) -> tuple[Float, float]:
    """Return the normals whose winding number is most that of a closed surface, and their disorder."""
    by_winding: list[Float] = []
    if len(points) <= _GAUSS_POINTS:
        by_winding = _by_winding(points, axes, free)
        unrest = winding_disorder(points, by_winding[-1])
        if unrest <= _ORDERLY:
            return by_winding[-1], unrest
    normals = propagate_orientation(points, axes, tangent_planes(points, _LOCAL), 0.0)
    unrest = winding_disorder(points, normals)
    if len(points) > _GAUSS_POINTS and unrest <= _ORDERLY:
        return normals, unrest
    second = propagate_orientation(points, axes, tangent_planes(points, _SMOOTH), _OFF_PLANE_PENALTY)
    normals, unrest = min((normals, unrest), (second, winding_disorder(points, second)), key=_unrest)
    others = [(found, winding_disorder(points, found)) for found in by_winding or _by_winding(points, axes, free)]
    third, other = min(others, key=_unrest)
    # An open scan stays disorderly either way, and there only propagation can be right.
    return (third, other) if other < _CLEARLY_BETTER * unrest else (normals, unrest)


def _unrest(candidate: tuple[Float, float]) -> float:
    return candidate[1]


def _by_winding(points: Float, axes: Float, free: bool) -> list[Float]:
    """Return unit normals signed by Gauss's theorem and by normals that agree with their winding number.

    Where all points take part and directions are `free`, the latter's own come last: in sparse clouds they are better
    than those of any neighbourhood.
    """
    from scipy.spatial import cKDTree

    order = np.random.default_rng(0).permutation(len(points))
    few, some = order[:_GAUSS_POINTS], order[:_CONSISTENT_POINTS]
    outward = gauss_normals(points[few])
    first = outward[cKDTree(points[few]).query(points[some])[1]]
    refined = consistent_normals(points[some], first)
    nearest = cKDTree(points[some]).query(points)[1]
    signed = [_signed(axes, guide[nearest]) for guide in (first, refined)]
    return [*signed, refined[nearest]] if free and len(some) == len(points) else signed


def _signed(axes: Float, guide: Float) -> Float:
    return np.asarray(axes * np.where(np.einsum("ij,ij->i", axes, guide) < 0, -1.0, 1.0)[:, None])


def flip_if_inward(points: Float, normals: Float) -> tuple[Float, bool]:
    """Return the normals, all flipped where they clearly look into a nearly closed surface, and whether they were.

    Parameters
    ----------
    points : array of shape (N, 3), distinct
    normals : array of shape (N, 3), of unit length
    """
    inward = outwardness(points - points.mean(axis=0), normals) < _INWARD
    return (-normals, True) if inward else (normals, False)


MODES = {
    "auto": "estimated where there are none; all turned around where they look into a closed surface",
    "given": "estimated where there are none, and otherwise taken as they are",
    "signs": "their directions kept, and the side of each found anew",
    "estimate": "estimated anew",
}
"""What `with_outward_normals` does with normals."""


def require_orientation(mode: str) -> None:
    """Refuse a mode that is not known.

    Raises
    ------
    UsageError
    """
    if mode not in MODES:
        raise UsageError(f"Normals can be oriented by {', '.join(MODES)}, not {mode!r}.")


def with_outward_normals(cloud: PointCloud, mode: str) -> tuple[PointCloud, Orientation]:
    """Return the cloud with outward unit normals, and how they came about.

    Parameters
    ----------
    cloud : with unit normals or none
    mode : a name of `MODES`

    Raises
    ------
    InputError
        When normals cannot be estimated.
    """
    normals = cloud.normals
    if normals is None or mode == "estimate":
        found = oriented_normals(cloud.points, cloud.origins)
    elif mode == "signs":
        sides = oriented_normals(cloud.points, cloud.origins, along=normals)
        turned = float((np.einsum("ij,ij->i", sides.normals, normals) < 0).mean())
        found = Orientation(sides.normals, "given, sides " + sides.how, sides.confidence, turned)
    else:
        kept, inward = flip_if_inward(cloud.points, normals) if mode == "auto" else (normals, False)
        found = Orientation(kept, "given, flipped" if inward else "given", None, float(inward))
    return cloud.with_normals(found.normals), found
