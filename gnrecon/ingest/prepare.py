"""From a cloud as read to the samples that a fit sees."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np

from gnrecon.geometry.point_cloud import Frame, PointCloud, Samples
from gnrecon.geometry.units import parse_reach
from gnrecon.ingest.clean import LEAST_POINTS, clean
from gnrecon.ingest.counts import IngestCounts
from gnrecon.ingest.noise import mean_spacing
from gnrecon.ingest.orientation import require_orientation, with_outward_normals
from gnrecon.ingest.smooth import smooth_points
from gnrecon.ingest.subsample import subsample as thin
from gnrecon.runtime.errors import UsageError
from gnrecon.runtime.progress import ProgressCallback, ignore_progress

_log = logging.getLogger(__name__)

CLEANED, ORIENTED = 0.2, 0.7
"""About which shares of the time have passed after cleaning and after the normals."""

_HELD_OUT = 1
"""Tells the choice of held-out points from that of the kept ones, which has the same seed."""


def prepare(
    cloud: PointCloud,
    *,
    outliers: str = "auto",
    clusters: str = "auto",
    smooth_scan: float | str | None = None,
    fraction: float | None = None,
    max_points: int | None = None,
    spacing: float | str | None = None,
    subsample: str = "random",
    holdout: float | None = None,
    orient: str = "auto",
    units: str | None = None,
    seed: int = 0,
    advance: ProgressCallback = ignore_progress,
) -> tuple[Samples, IngestCounts]:
    """Clean a cloud, orient it, smooth it if asked to, thin it, and move it into the unit ball, in this order.

    Normals are estimated before thinning, because all points together tell them better.

    Parameters
    ----------
    cloud : in file units
    outliers, clusters : ``"auto"``, ``"on"`` or ``"off"``, and for outliers other rules, see `clean`
    smooth_scan : width of the surroundings that smoothing takes in, see `smooth`; may be given as a spacing may
    fraction, max_points, spacing, subsample, seed : how many points to keep and how to choose them, see `subsample`,
        where `subsample` is called `method`; a spacing may be given in mean spacings of the points, as ``"2s"``
    holdout : share of the points, in (0, 1), that are kept from the fit as `Samples.held_out`
    orient : which normals and sides are estimated, see `with_outward_normals`
    units : the cloud's unit, for a length in another one, as ``"2mm"``
    advance : told of the share that is done after each of them

    Raises
    ------
    InputError
        When the cloud has too few usable points or spans no volume.
    UsageError
        When an argument is out of its range, or thinning would leave fewer than 10 points.
    """
    require_orientation(orient)
    cleaned, counts = clean(cloud, outliers, clusters=clusters, units=units)
    advance(CLEANED)
    oriented, orientation = with_outward_normals(cleaned, orient)
    advance(ORIENTED)
    oriented, held_out = _hold_out(oriented, holdout, seed)
    # Distances between points are those of the whole cloud.
    apart, width = (
        None if text is None else parse_reach(str(text), mean_spacing(cleaned.points), units)
        for text in (spacing, smooth_scan)
    )
    oriented, moved = _smooth(oriented, width)
    kept = thin(oriented, fraction=fraction, max_points=max_points, spacing=apart, method=subsample, seed=seed)
    if len(kept) < LEAST_POINTS:
        raise UsageError(f"Subsampling leaves {len(kept)} points, but a surface needs at least {LEAST_POINTS}.")
    counts = replace(counts, moved=moved, thinned=len(oriented) - len(kept), held_out=len(held_out), kept=len(kept))
    counts = replace(counts, normals=orientation.how, confidence=orientation.confidence, flipped=orientation.flipped)
    assert kept.normals is not None
    frame = Frame.of(kept.points)
    _log.info(
        "Kept %d of %d points, %d apart from the fit; normals: %s; centre %s, radius %.6g.",
        len(kept),
        len(cloud),
        len(held_out),
        orientation.how,
        frame.center.tolist(),
        frame.scale,
    )
    held = _held_samples(held_out, frame)
    return Samples(frame.to_unit(kept.points), kept.normals, frame, held, orientation.estimated), counts


def _hold_out(cloud: PointCloud, share: float | None, seed: int) -> tuple[PointCloud, PointCloud]:
    """Split off a random share of the points."""
    if share is not None and not 0 < share < 1:
        raise UsageError(f"The share of points to hold out is {share}, but must lie between 0 and 1.")
    held = np.zeros(len(cloud), bool)
    held[np.random.default_rng([seed, _HELD_OUT]).permutation(len(cloud))[: round((share or 0.0) * len(cloud))]] = True
    return cloud.select(~held), cloud.select(held)


def _smooth(cloud: PointCloud, width: float | None) -> tuple[PointCloud, float | None]:
    """Smooth the points over a width, if there is one, and tell how far they moved in the root mean square."""
    if width is None or cloud.normals is None:
        return cloud, None
    centre = cloud.points.mean(axis=0)
    points, normals = smooth_points(cloud.points - centre, cloud.normals, width)
    moved = float(np.sqrt(((points - (cloud.points - centre)) ** 2).sum(axis=1).mean()))
    return replace(cloud, points=points + centre, normals=normals), moved


def _held_samples(held_out: PointCloud, frame: Frame) -> Samples | None:
    if not len(held_out) or held_out.normals is None:
        return None
    return Samples(frame.to_unit(held_out.points), held_out.normals, frame)
