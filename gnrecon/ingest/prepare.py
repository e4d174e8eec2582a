"""From a cloud as read to the samples that a fit sees."""

from __future__ import annotations

from dataclasses import replace

from gnrecon.advance import Advance, unheard
from gnrecon.cloud import Frame, PointCloud, Samples
from gnrecon.errors import UsageError
from gnrecon.ingest.clean import LEAST_POINTS, clean
from gnrecon.ingest.counts import IngestCounts
from gnrecon.ingest.normals import flip_if_inward, oriented_normals
from gnrecon.ingest.subsample import subsample as thin

CLEANED, ORIENTED = 0.2, 0.7
"""About which shares of the time have passed after cleaning and after the normals."""


def prepare(
    cloud: PointCloud,
    *,
    outliers: str = "auto",
    fraction: float | None = None,
    max_points: int | None = None,
    subsample: str = "random",
    seed: int = 0,
    advance: Advance = unheard,
) -> tuple[Samples, IngestCounts]:
    """Clean a cloud, orient it, thin it, and move it into the unit ball, in this order.

    Normals are estimated before thinning, because all points together tell them better.

    Parameters
    ----------
    cloud : in file units
    outliers : ``"auto"``, ``"on"`` or ``"off"``, see `clean`
    fraction, max_points, subsample, seed : how many points to keep and how to choose them, see `subsample`, where
        `subsample` is called `method`
    advance : told of the share that is done after each of them

    Raises
    ------
    InputError
        When the cloud has too few usable points or spans no volume.
    UsageError
        When an argument is out of its range, or thinning would leave fewer than 10 points.
    """
    cleaned, counts = clean(cloud, outliers)
    advance(CLEANED)
    if cleaned.normals is None:
        normals, how = oriented_normals(cleaned.points)
    else:
        normals, flipped = flip_if_inward(cleaned.points, cleaned.normals)
        how = "given, flipped" if flipped else "given"
    advance(ORIENTED)
    oriented = cleaned.with_normals(normals)
    kept = thin(oriented, fraction=fraction, max_points=max_points, method=subsample, seed=seed)
    if len(kept) < LEAST_POINTS:
        raise UsageError(f"Subsampling leaves {len(kept)} points, but a surface needs at least {LEAST_POINTS}.")
    counts = replace(counts, thinned=len(cleaned) - len(kept), kept=len(kept), normals=how)
    assert kept.normals is not None
    frame = Frame.of(kept.points)
    return Samples(frame.to_unit(kept.points), kept.normals, frame), counts
