"""Outward normals: estimates them where a cloud has none, checks and orients given ones.

Unoriented normals come from neighbourhoods (`gnrecon.ingest.normals`); the difficulty is their sign. Where the position
of the scanner is known, the line of sight decides (`orient_towards_scanner`). Otherwise there are two ways:

- *propagation* along a spanning tree (`propagate_orientation`): right for dense scans, open ones included; the overall
  sign stays undetermined, and it fails at thin walls and in sparse regions;
- *Gauss's theorem* solved for all normals at once (`gauss_normals`), and normals that agree with their own winding
  number (`consistent_normals`): right for sparse closed clouds, thin walls included, and outward by construction; used
  on up to a few thousand points, from which the others take their sign.

The winding number of the result (`winding_at_points`) measures the confidence. Where it is that of a closed surface
with both, the second way is taken. Otherwise it decides only where neighbours do not contradict it: in an open scene,
such as objects on a ground, normals of changing signs may have a winding number nearer to that of a closed surface than
the right ones. Signs that change within a sheet show: the neighbours that face the other way lie in front of a point as
often as behind it (`Agreement`).

Of few points without noise, the normals then become those of the smoothest surface (`geometry.spline_patches`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gnrecon.geometry.arrays import Float
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.geometry.spline_patches import SplineParameters, are_exact, smoothest_normals
from gnrecon.ingest.ingest_parameters import IngestParameters, OrientationParameters
from gnrecon.ingest.line_scans import lie_on_lines
from gnrecon.ingest.normal_agreement import Agreement, agreement_of
from gnrecon.ingest.normals import tangent_planes, unoriented_normals
from gnrecon.ingest.orientation_methods import (
    consistent_normals,
    gauss_normals,
    is_open,
    orient_towards_scanner,
    outwardness,
    propagate_orientation,
    winding_agreement,
    winding_disorder,
)
from gnrecon.runtime.errors import InputError, UsageError


@dataclass(frozen=True)
class Orientation:
    """Outward normals and their origin.

    Parameters
    ----------
    normals : array of shape (N, 3), of unit length
    how : such as ``"estimated"``; ``"estimated, upward, as of an open surface"`` where neighbours agree on an open
        surface; ``"estimated, orientation uncertain"`` where the winding number is far from that of a closed surface
        otherwise; ``"estimated, oriented by origins"``
    confidence : share in [0, 1] of the points that confirm their sign: the winding number there is that of a closed
        surface with outward normals; on an open surface, most neighbours do not face the other way; by origins, the
        line of sight is clear of the tangent plane; None for given signs
    flipped : share in [0, 1] of the given normals that were flipped
    clean : whether the points have no noise that matters, where that is known; of many points, whose normals are not
        those of the smoothest surface, only True is known
    deviations : array of shape (N,), standard deviations of the normals along each tangent, radians, if they are known
    """

    normals: Float
    how: str
    confidence: float | None = None
    flipped: float = 0.0
    clean: bool | None = None
    deviations: Float | None = None

    @property
    def estimated(self) -> bool:
        """Whether at least the signs are estimates."""
        return self.confidence is not None


def oriented_normals(
    points: Float,
    origins: Float | None = None,
    along: Float | None = None,
    *,
    most_points: int = SplineParameters.most_points,
    parameters: IngestParameters = IngestParameters(),
) -> Orientation:
    """Estimate outward unit normals: towards the scanner where it is known, and mostly upward (+z) for an open sheet.

    Parameters
    ----------
    points : array of shape (N, 3), distinct, N >= 10
    origins : array of shape (N, 3), optional
        Positions of the scanner; rows of NaN where they are unknown.
    along : array of shape (N, 3), optional
        Unit normals of which only the signs are estimated.
    most_points : of which normals and noise are found together, see `geometry.spline_patches`
    parameters : tuning constants

    Raises
    ------
    InputError
        When the points cannot be triangulated, for example fewer than four.
    """
    middle = points.mean(axis=0)
    centred = points - middle
    if len(points) <= 3:
        raise InputError(f"Normals cannot be estimated from {len(points)} points that span no volume.")
    axes = unoriented_normals(centred, parameters=parameters.normals) if along is None else along
    seen = orient_towards_scanner(centred, axes, None if origins is None else origins - middle)
    if seen is not None:
        return Orientation(seen[0], "estimated, oriented by origins", seen[1])
    normals, disorder = _by_shape(centred, axes, along is None, parameters)
    clean: bool | None = None
    deviations = None
    # The nearest points of a point on a line are those of the line, which span no surface.
    if along is None and not lie_on_lines(centred, parameters=parameters.lines):
        if len(points) > most_points:
            # Creases of a dense scan may pass for noise here; its pairs of points tell more.
            clean = are_exact(centred, normals) or None
        else:
            smoothest = smoothest_normals(centred, normals)
            clean = smoothest is not None
            if smoothest is not None:
                normals, deviations = smoothest.normals, smoothest.deviations
    if disorder <= parameters.orientation.most_disorder:
        how, confidence = "estimated", winding_agreement(centred, normals)
        return Orientation(normals, how, confidence, clean=clean, deviations=deviations)
    agreement = agreement_of(centred, normals)
    if is_open(outwardness(centred, normals)) and agreement.conflicting <= parameters.orientation.most_conflicting:
        how, confidence = "estimated, upward, as of an open surface", 1 - agreement.contradicted
    else:
        how, confidence = "estimated, orientation uncertain", winding_agreement(centred, normals)
    return Orientation(normals, how, confidence, clean=clean, deviations=deviations)


def _by_shape(points: Float, axes: Float, free: bool, parameters: IngestParameters) -> tuple[Float, float]:
    """Return the normals whose winding number is closest to that of a closed surface, and their disorder.

    Signs by winding number that neighbours contradict are not among them. `free` says whether the axes may be replaced
    by better ones.
    """
    limits, planes = parameters.orientation, parameters.normals
    by_winding: list[Float] = []
    if len(points) <= limits.gauss_points:
        by_winding = _by_winding(points, axes, free, parameters)
        disorder = winding_disorder(points, by_winding[-1])
        agreement = agreement_of(points, by_winding[-1])
        if disorder <= limits.most_disorder and _uncontradicted(agreement, 0.0, limits):
            return by_winding[-1], disorder
    local = tangent_planes(points, limits.local_neighbours, parameters=planes)
    normals = propagate_orientation(points, axes, local, 0.0)
    disorder = winding_disorder(points, normals)
    if len(points) > limits.gauss_points and disorder <= limits.most_disorder:
        return normals, disorder
    smooth = tangent_planes(points, limits.smooth_neighbours, parameters=planes)
    second = propagate_orientation(points, axes, smooth, limits.off_plane_penalty)
    normals, disorder, own = _propagated(points, normals, second, limits)
    others = by_winding or _by_winding(points, axes, free, parameters)
    outward = outwardness(points, normals)
    if outward >= limits.closed_outwardness:
        # Noise and thin legs raise the disorder and the conflicts of right signs as of wrong ones; on closed surfaces
        # the winding number has fewer wrong signs than any propagation, unless it divides a thick layer of points.
        refined, ratio = winding_disorder(points, others[-1]), limits.closed_ratio
        if refined <= ratio * disorder and ratio * outwardness(points, others[-1]) >= outward:
            return others[-1], refined
        return normals, disorder
    third, other = min(((found, winding_disorder(points, found)) for found in others), key=_disorder)
    agreement = agreement_of(points, third)
    allowed = agreement.shows_walls() or agreement.conflicting < own.conflicting - limits.most_conflicting
    allowed |= other <= limits.most_disorder and _uncontradicted(agreement, own.conflicting, limits)
    better = other < limits.better_disorder_ratio * disorder
    return (third, other) if allowed and better else (normals, disorder)


def _uncontradicted(agreement: Agreement, usual: float, limits: OrientationParameters) -> bool:
    """Return whether neighbours agree, but at thin walls, up to what is usual for the scan."""
    return agreement.shows_walls() or agreement.conflicting <= usual + limits.most_conflicting


def _propagated(
    points: Float, first: Float, second: Float, limits: OrientationParameters, *, least_facing: float = 0.3
) -> tuple[Float, float, Agreement]:
    """Return the better one of two propagated orientations, its disorder, and how its neighbours agree.

    Where neighbours contradict one of them more than the other, it is the other, else that of less disorder. In an
    open scene, which was seen from one side, it is the one that faces one side more: whose mean normal is longer, and
    at least `least_facing`. Normals of closed surfaces cancel.
    """
    found = [(normals, winding_disorder(points, normals), agreement_of(points, normals)) for normals in (first, second)]
    conflicts = [agreement.conflicting for _, _, agreement in found]
    if abs(conflicts[0] - conflicts[1]) > limits.most_conflicting:
        return found[int(conflicts[1] < conflicts[0])]
    facing = [float(np.linalg.norm(normals.mean(axis=0))) for normals, _, _ in found]
    if min(found[0][1], found[1][1]) > limits.most_disorder and max(facing) > least_facing:
        return found[int(facing[1] > facing[0])]
    return min(found, key=lambda one: one[1])


def _disorder(candidate: tuple[Float, float]) -> float:
    return candidate[1]


def _by_winding(points: Float, axes: Float, free: bool, parameters: IngestParameters) -> list[Float]:
    """Return unit normals with signs by Gauss's theorem, and by normals that agree with their winding number.

    Where all points take part and axes are `free`, the latter normals themselves come last: in sparse clouds they are
    better than those of any neighbourhood.
    """
    from scipy.spatial import cKDTree

    order = np.random.default_rng(0).permutation(len(points))
    few, some = order[: parameters.orientation.gauss_points], order[: parameters.orientation.consistent_points]
    outward = gauss_normals(points[few])
    first = outward[cKDTree(points[few]).query(points[some])[1]]
    refined = consistent_normals(points[some], first)
    nearest = cKDTree(points[some]).query(points)[1]
    signed = [_signed(axes, guide[nearest]) for guide in (first, refined)]
    return [*signed, refined[nearest]] if free and len(some) == len(points) else signed


def _signed(axes: Float, guide: Float) -> Float:
    """Return the axes with the signs of the guide."""
    return np.asarray(axes * np.where(np.einsum("ij,ij->i", axes, guide) < 0, -1.0, 1.0)[:, None])


def flip_if_inward(points: Float, normals: Float, *, inward_outwardness: float = -0.75) -> tuple[Float, bool]:
    """Return the normals, all flipped if they clearly point into a nearly closed surface, and whether they were.

    Parameters
    ----------
    points : array of shape (N, 3), distinct
    normals : array of shape (N, 3), of unit length
    inward_outwardness : outwardness below which they are flipped; half a sphere with inward normals has about -0.6,
        and may be the scan of a bowl
    """
    inward = outwardness(points - points.mean(axis=0), normals) < inward_outwardness
    return (-normals, True) if inward else (normals, False)


def are_inconsistent(points: Float, normals: Float, *, most_contradicted: float = 0.012) -> bool:
    """Return whether many normals contradict their neighbours', other than on both sides of thin walls and slots.

    Parameters
    ----------
    points : array of shape (N, 3), distinct, N > 1
    normals : array of shape (N, 3), of unit length
    most_contradicted : share of the points, see `Agreement`, above which normals are inconsistent. Machine parts with
        noisy slots have up to 0.009, a twentieth of normals turned around 0.011 to 0.02. Where a part of a scan has the
        wrong signs consistently, only the points at its edge are among them.
    """
    return agreement_of(points, normals).contradicted > most_contradicted


ORIENTATIONS = {
    "auto": "estimated where missing or inconsistent; all flipped where they point into a closed surface",
    "given": "estimated where missing, and otherwise unchanged",
    "signs": "directions kept, signs estimated",
    "estimate": "estimated from the points",
}
"""What `with_outward_normals` does with normals."""


def require_orientation(mode: str) -> None:
    """Check that a mode is one of `ORIENTATIONS`.

    Raises
    ------
    UsageError
    """
    if mode not in ORIENTATIONS:
        raise UsageError(f"Normals can be oriented by {', '.join(ORIENTATIONS)}, not {mode!r}.")


def with_outward_normals(
    cloud: PointCloud, mode: str, axes: Float | None = None, *, parameters: IngestParameters = IngestParameters()
) -> tuple[PointCloud, Orientation]:
    """Return the cloud with outward unit normals, and their origin.

    Parameters
    ----------
    cloud : with unit normals or none
    mode : one of `ORIENTATIONS`
    axes : array of shape (N, 3), optional
        Unit normals of either sign, to be oriented where normals are estimated; by default from the neighbours.
    parameters : tuning constants

    Raises
    ------
    InputError
        When normals cannot be estimated.
    """
    normals = cloud.normals
    if normals is None or mode == "estimate":
        found = oriented_normals(cloud.points, cloud.origins, axes, parameters=parameters)
    elif mode == "auto" and are_inconsistent(cloud.points - cloud.points.mean(axis=0), normals):
        found = oriented_normals(cloud.points, cloud.origins, axes, parameters=parameters)
        found = replace(found, how=f"{found.how}, because the given ones are inconsistent")
    elif mode == "signs":
        sides = oriented_normals(cloud.points, cloud.origins, along=normals, parameters=parameters)
        turned = float((np.einsum("ij,ij->i", sides.normals, normals) < 0).mean())
        found = Orientation(sides.normals, "given, sides " + sides.how, sides.confidence, turned)
    else:
        kept, inward = flip_if_inward(cloud.points, normals) if mode == "auto" else (normals, False)
        found = Orientation(kept, "given, flipped" if inward else "given", None, float(inward))
    return cloud.with_normals(found.normals), found
