"""Ingest as a whole: cleans, orients, smooths and thins a cloud, and moves it into the unit ball."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np

from gnrecon.geometry.arrays import Float
from gnrecon.geometry.point_cloud import Frame, PointCloud, Samples
from gnrecon.geometry.units import parse_reach
from gnrecon.ingest.clean import clean
from gnrecon.ingest.counts import IngestCounts
from gnrecon.ingest.ingest_parameters import IngestParameters
from gnrecon.ingest.line_scans import lie_on_lines, normals_across_lines, rows_along_lines, thinned_along_lines
from gnrecon.ingest.noise import estimate_noise
from gnrecon.ingest.normal_agreement import sheet_thickness
from gnrecon.ingest.normals import unoriented_normals
from gnrecon.ingest.orientation import Orientation, are_inconsistent, require_orientation, with_outward_normals
from gnrecon.ingest.point_spacing import mean_spacing
from gnrecon.ingest.smooth import smooth_points
from gnrecon.ingest.subsample import subsample as thin
from gnrecon.ingest.survey import fill_a_volume, outer_surface
from gnrecon.runtime.errors import UsageError
from gnrecon.runtime.progress import ProgressCallback, ignore_progress

_log = logging.getLogger(__name__)


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
    parameters: IngestParameters = IngestParameters(),
) -> tuple[Samples, IngestCounts]:
    """Clean a cloud, orient it, smooth it if requested, thin it, and move it into the unit ball, in this order.

    Normals are estimated before thinning, because they are more accurate from all points.

    Parameters
    ----------
    cloud : in file units
    outliers, clusters : ``"auto"``, ``"on"`` or ``"off"``, and for outliers other rules, see `clean`
    smooth_scan : radius of the neighbourhoods for smoothing, see `smooth_points`; a length or spacings, as ``"8s"``
    fraction, max_points, spacing, subsample, seed : how many points to keep and how to choose them, see `subsample`,
        where `subsample` is called `method`; a spacing may be given in mean spacings of the points, as ``"2s"``
    holdout : share of the points, in (0, 1), that become validation points, `Samples.held_out`
    orient : which normals and signs are estimated, see `with_outward_normals`
    units : the cloud's unit, for a length in another one, as ``"2mm"``
    advance : called with the share that is done after each step
    parameters : tuning constants

    Raises
    ------
    InputError
        When the cloud has too few usable points or spans no volume.
    UsageError
        When an argument is out of its range, or thinning would leave fewer than 10 points.
    """
    require_orientation(orient)
    cleaned, counts = clean(cloud, outliers, clusters=clusters, units=units, parameters=parameters)
    advance(0.2)  # cleaning takes about a fifth of the time, and normals another half
    centred = cleaned.points - cleaned.points.mean(axis=0)
    arrangement = (
        "lines" if lie_on_lines(centred, parameters=parameters.lines) else "volume" if fill_a_volume(centred) else None
    )
    counts = replace(counts, arrangement=arrangement)
    if arrangement == "volume" and cleaned.normals is None:
        outer, normals = outer_surface(centred)
        cleaned = cleaned.select(outer).with_normals(normals)
        counts = replace(counts, inner=int((~outer).sum()))
    axes, clear = None, None
    if arrangement == "lines":
        clear = _clear_of_few(cleaned, orient, parameters)
        if clear is None:
            cleaned, axes, half = _along_lines(cleaned, orient, parameters)
            counts = replace(counts, along_lines=len(centred) - len(cleaned), half_line_distance=half)
    oriented, orientation = clear or with_outward_normals(cleaned, orient, axes, parameters=parameters)
    if counts.inner:
        orientation = replace(orientation, how="estimated, outward from the volume", confidence=1.0)
    advance(0.7)
    if orientation.deviations is not None:
        # No other values are used from here on.
        oriented = replace(oriented, attributes={"deviations": orientation.deviations})
    oriented, held_out = _hold_out(oriented, holdout, seed)
    # Spacings are those of the whole cloud.
    lengths = (spacing, smooth_scan)
    apart, width = (x if x is None else parse_reach(str(x), mean_spacing(cleaned.points), units) for x in lengths)
    oriented, moved = _smooth(oriented, width, parameters)
    if moved is not None:
        # What was found of points that lay elsewhere.
        orientation = replace(orientation, clean=None, deviations=None)
    kept = thin(oriented, fraction=fraction, max_points=max_points, spacing=apart, method=subsample, seed=seed)
    if len(kept) < (least := parameters.least_points):
        raise UsageError(f"Subsampling leaves {len(kept)} points, but a surface needs at least {least}.")
    counts = replace(counts, moved=moved, thinned=len(oriented) - len(kept), held_out=len(held_out), kept=len(kept))
    counts = replace(counts, normals=orientation.how, confidence=orientation.confidence, flipped=orientation.flipped)
    message = "Kept %d of %d points, %d for validation; normals: %s."
    _log.info(message, len(kept), len(cloud), len(held_out), orientation.how)
    return _in_unit_ball(kept, held_out, orientation), counts


def _clear_of_few(
    cloud: PointCloud, orient: str, parameters: IngestParameters
) -> tuple[PointCloud, Orientation] | None:
    """Return few points with normals by their winding number where that is clearly of a closed surface; else None.

    All points then serve the fit, and no neighbours, which lie on one line, the normals.
    """
    if len(cloud) > parameters.orientation.gauss_points or (cloud.normals is not None and orient != "estimate"):
        return None
    found = with_outward_normals(cloud, orient, parameters=parameters)
    closed = found[1].how == "estimated"  # and neither upward nor uncertain
    return found if closed and (found[1].confidence or 0.0) >= parameters.lines.least_confidence else None


def _along_lines(
    cloud: PointCloud, orient: str, parameters: IngestParameters
) -> tuple[PointCloud, Float | None, float | None]:
    """Return a cloud of points along lines, thinned, its normals of either sign, and about half of the lines' distance.

    Where normals are given, there are none of these.
    """
    points, limits = cloud.points - cloud.points.mean(axis=0), parameters.lines
    rows, side = thinned_along_lines(points, parameters=limits)
    if cloud.normals is not None and (
        orient in ("given", "signs") or (orient == "auto" and not are_inconsistent(points, cloud.normals))
    ):
        rows, axes = rows_along_lines(points, limits.given_side_share * side), None
    else:
        axes, found = normals_across_lines(points, rows, side, parameters=limits)
        axes[~found] = unoriented_normals(points[rows], parameters=parameters.normals)[~found]
    # Lines so far apart that hardly a point would be left are none of a scan's.
    return (cloud, None, None) if len(rows) < parameters.least_points else (cloud.select(rows), axes, side)


def _hold_out(cloud: PointCloud, share: float | None, seed: int) -> tuple[PointCloud, PointCloud]:
    """Split off a random share of the points for validation."""
    if share is not None and not 0 < share < 1:
        raise UsageError(f"The share of points to hold out is {share}, but must lie between 0 and 1.")
    held = np.zeros(len(cloud), bool)
    rng = np.random.default_rng([seed, 1])  # a stream of its own: thinning uses the seed as well
    held[rng.permutation(len(cloud))[: round((share or 0.0) * len(cloud))]] = True
    return cloud.select(~held), cloud.select(held)


def _smooth(cloud: PointCloud, width: float | None, parameters: IngestParameters) -> tuple[PointCloud, float | None]:
    """Smooth the points over a width, if there is one; also return how far they moved in the root mean square."""
    if width is None or cloud.normals is None:
        return cloud, None
    centre = cloud.points.mean(axis=0)
    points, normals = smooth_points(cloud.points - centre, cloud.normals, width, parameters=parameters.smoothing)
    moved = float(np.sqrt(((points - (cloud.points - centre)) ** 2).sum(axis=1).mean()))
    return replace(cloud, points=points + centre, normals=normals), moved


def _in_unit_ball(kept: PointCloud, held_out: PointCloud, orientation: Orientation) -> Samples:
    """Return the samples of a fit, with the validation points in the same frame."""
    assert kept.normals is not None
    frame, held = Frame.of(kept.points), None
    _log.info("The unit ball has the centre %s and the radius %.6g.", frame.center.tolist(), frame.scale)
    if len(held_out) and held_out.normals is not None:
        held = Samples(frame.to_unit(held_out.points), held_out.normals, frame)
    points, normals = frame.to_unit(kept.points), kept.normals
    layer = points
    if not orientation.estimated and sheet_thickness(points, normals) is not None:
        # The two sides of a thin sheet would look like noise; one of them shows it.
        layer = points[normals @ np.linalg.eigh(normals.T @ normals)[1][:, -1] > 0.5]
    noise = estimate_noise(layer, mean_spacing(layer)).deviation if len(layer) >= 16 else None
    deviations = None if orientation.deviations is None else kept.attributes["deviations"].astype(float)
    return Samples(points, normals, frame, held, orientation.estimated, noise, orientation.clean, deviations)
