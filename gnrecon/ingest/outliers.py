"""Outliers: scattered points far off the surface, found by local density; and the two usual rules, by open3d.

With m_i the mean distance of point i to its k nearest neighbours, a global bound on m_i would delete regions that were
scanned from afar or at a grazing angle. Two tests avoid this:

- *relative*: log(m_i / median of m over its neighbours) is near 0 in dense and in thin regions alike, and large for a
  point above a denser sheet. The bound is robust (median and median absolute deviation), and at least a factor of 3.
  Removing such points uncovers others, so the test is repeated with the same bound.
- *scattered*: points surrounded only by other outliers pass the first test, but they fill a volume: the surface
  variation of their neighbourhood is large, whereas a thin scan is still a sheet.

The usual rules are *statistical*, the mean distance to the 16 nearest points exceeds its mean over the cloud by a
number of standard deviations (Rusu et al. 2008), and *radius*, fewer than a number of other points lie within a
distance. Both take thinly scanned regions for outliers, so they are not the default.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gnrecon.geometry.arrays import Float, Int, Mask
from gnrecon.geometry.local_pca import surface_variation
from gnrecon.geometry.statistics import robust_deviation
from gnrecon.geometry.units import parse_reach
from gnrecon.ingest.ingest_parameters import DensityOutlierParameters
from gnrecon.ingest.point_spacing import mean_spacing
from gnrecon.runtime.errors import UsageError
from gnrecon.runtime.quiet_imports import import_open3d

REMOVAL_MODES = ("auto", "on", "off")
"""When outliers or clusters are removed: unless they are many, always, never."""


def find_outliers(points: Float, *, parameters: DensityOutlierParameters = DensityOutlierParameters()) -> Mask:
    """Return the mask, of shape (N,), of scattered points far off the surface.

    Parameters
    ----------
    points : array of shape (N, 3), centred, N > 1
    parameters : tuning constants
    """
    remaining, least = np.arange(len(points)), np.finfo(np.float64).tiny
    bound: float | None = None
    for _ in range(parameters.passes):
        if len(remaining) <= parameters.neighbours:
            break
        spacing, neighbours = _spacing(points[remaining], parameters.neighbours)
        # A difference of logarithms, because in damaged scans a ratio may overflow.
        own, around = (np.maximum(x, least) for x in (spacing, np.median(spacing[neighbours], axis=1)))
        ratio = np.log(own) - np.log(around)
        if bound is None:
            middle = float(np.median(ratio))
            spread = robust_deviation(ratio - middle)
            bound = max(float(np.log(parameters.least_ratio)), middle + parameters.deviations * spread)
        far = ratio > bound
        sparse = np.flatnonzero(spacing > parameters.sparse_spacings * np.median(spacing))
        far[sparse] |= surface_variation(points[remaining][neighbours[sparse]]) > parameters.most_surface_variation
        if not far.any():
            break
        remaining = remaining[~far]
    outliers = np.ones(len(points), bool)
    outliers[remaining] = False
    return outliers


def _spacing(points: Float, count: int) -> tuple[Float, Int]:
    """Return the mean distance to the nearest neighbours, of shape (N,), and their indices, of shape (N, count)."""
    from scipy.spatial import cKDTree

    distances, neighbours = cKDTree(points).query(points, count + 1)
    # Distinct points may lie so close that a distance underflows; the logarithm needs a positive one.
    return np.maximum(distances[:, 1:].mean(axis=1), np.finfo(np.float64).tiny), neighbours[:, 1:]


@dataclass(frozen=True)
class OutlierRule:
    """How outliers are found and whether they are dropped.

    Parameters
    ----------
    name : one of `REMOVAL_MODES`, ``"statistical"`` or ``"radius"``
    deviations : of the statistical rule, in standard deviations
    distance, within : of the radius rule: a length as text, and the least number of other points
    """

    name: str
    deviations: float = 2.0
    distance: str = "1"
    within: int = 4


def parse_outliers(text: str, units: str | None) -> OutlierRule:
    """Return the outlier rule that a text describes.

    Parameters
    ----------
    text : ``auto``, ``on``, ``off``, ``statistical``, ``statistical:2.5`` (deviations), ``radius:3s`` or
        ``radius:0.5,4`` (distance in file units, with a unit, or in spacings; and least number of other points)
    units : the file's unit, where it is known

    Raises
    ------
    UsageError
        When the text is none of these.
    """
    name, _, rest = text.partition(":")
    if text in REMOVAL_MODES or text == "statistical":
        return OutlierRule(text)
    try:
        if name == "statistical" and 0 < float(rest) < np.inf:
            return OutlierRule(name, float(rest))
        if name == "radius":
            distance, _, within = rest.partition(",")
            parse_reach(distance, 1.0, units)
            if not within or int(within) >= 1:
                return OutlierRule(name, distance=distance, within=int(within or OutlierRule.within))
    except ValueError:
        pass
    raise UsageError(
        f"The outlier mode {text!r} is unknown; expected one of {', '.join(REMOVAL_MODES)}, statistical:DEVIATIONS, or "
        f"radius:DISTANCE,POINTS such as radius:3s,4."
    )


def outliers_by_rule(points: Float, rule: OutlierRule, units: str | None, *, neighbours: int = 16) -> Mask:
    """Return the mask, of shape (N,), of outliers by the statistical or the radius rule.

    Parameters
    ----------
    points : array of shape (N, 3), centred, distinct, N > 1
    rule : one of these two
    units : the points' unit, where it is known
    neighbours : of the statistical rule, as in `find_outliers`
    """
    open3d = import_open3d()

    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    if rule.name == "statistical":
        kept = cloud.remove_statistical_outlier(neighbours + 1, rule.deviations)[1]
    else:
        reach = parse_reach(rule.distance, mean_spacing(points), units)
        # open3d counts the point itself, and requires more than the number.
        kept = cloud.remove_radius_outlier(rule.within, reach)[1]
    mask = np.ones(len(points), bool)
    mask[np.asarray(kept, np.intp)] = False
    return mask
