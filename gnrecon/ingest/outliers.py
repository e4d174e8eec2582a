"""Scattered points far off the surface, found by local density and without harm to thinly scanned regions.

With m_i the mean distance of point i to its k nearest neighbours, a global bound on m_i would delete whatever the
scanner saw at a distance or at a grazing angle. Two tests spare it:

- *relative*: log(m_i / median of m over its neighbours) is near 0 in dense and in thin regions alike, and large for a
  point that hangs above a denser sheet. The bound is robust (median and median absolute deviation), never below a
  factor of 3. Removing such points uncovers others, so the test is repeated with the same bound.
- *scattered*: points in whose surroundings there are only other outliers pass the first test, but they fill a volume:
  the covariance of their neighbourhood is thick, whereas a thin scan is still a sheet.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gnrecon.geometry.arrays import Float, Int, Mask
from gnrecon.geometry.local_pca import surface_variation
from gnrecon.geometry.statistics import robust_deviation
from gnrecon.geometry.units import parse_reach
from gnrecon.ingest.noise import mean_spacing
from gnrecon.runtime.errors import UsageError

_NEIGHBOURS = 16

_DEVIATIONS = 6.0

_LEAST_FACTOR = 3.0

_PASSES = 8

_SPARSE_FACTOR = 4.0  # times the median spacing, beyond which thickness is looked at

_THICKNESS = 0.08  # smallest eigenvalue's share; about 0.03 at most for a curved sheet, 0.15 for points in a volume


def find_outliers(points: Float) -> Mask:
    """Return the mask, of shape (N,), of scattered points far off the surface.

    Parameters
    ----------
    points : array of shape (N, 3), centred, N > 1
    """
    remaining = np.arange(len(points))
    bound: float | None = None
    for _ in range(_PASSES):
        if len(remaining) <= _NEIGHBOURS:
            break
        spacing, neighbours = _spacing(points[remaining])
        ratio = np.log(spacing / np.median(spacing[neighbours], axis=1))
        if bound is None:
            middle = float(np.median(ratio))
            spread = robust_deviation(ratio - middle)
            bound = max(float(np.log(_LEAST_FACTOR)), middle + _DEVIATIONS * spread)
        far = ratio > bound
        sparse = np.flatnonzero(spacing > _SPARSE_FACTOR * np.median(spacing))
        far[sparse] |= surface_variation(points[remaining][neighbours[sparse]]) > _THICKNESS
        if not far.any():
            break
        remaining = remaining[~far]
    outliers = np.ones(len(points), bool)
    outliers[remaining] = False
    return outliers


def _spacing(points: Float) -> tuple[Float, Int]:
    """Return the mean distance to the nearest neighbours, of shape (N,), and their indices, of shape (N, k)."""
    from scipy.spatial import cKDTree

    distances, neighbours = cKDTree(points).query(points, _NEIGHBOURS + 1)
    # Distinct points may lie so close that a distance underflows; the logarithm needs a positive one.
    return np.maximum(distances[:, 1:].mean(axis=1), np.finfo(np.float64).tiny), neighbours[:, 1:]


MODES = ("auto", "on", "off")

_RULE_DEVIATIONS = 2.0

_LEAST_WITHIN = 4


# Outliers by the two rules that are in wide use, by open3d, for those who want exactly these.
#
# - *statistical*: the mean distance to the 16 nearest points is more than so many standard deviations above its mean
#   over the cloud (Rusu et al. 2008);
# - *radius*: fewer than so many other points lie within a distance.
#
# Both take a region that was scanned thinly for outliers, so that they are not the default, see `outliers`.


@dataclass(frozen=True)
class OutlierRule:
    """How outliers are found and whether they are dropped.

    Parameters
    ----------
    name : a name of `MODES`, ``"statistical"`` or ``"radius"``
    deviations : of the statistical rule
    distance, within : of the radius rule: a length as text, and the least number of other points
    """

    name: str
    deviations: float = _RULE_DEVIATIONS
    distance: str = "1"
    within: int = _LEAST_WITHIN


def parse_outliers(text: str, units: str | None) -> OutlierRule:
    """Return the rule that a text names.

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
    if text in MODES or text == "statistical":
        return OutlierRule(text)
    try:
        if name == "statistical" and 0 < float(rest) < np.inf:
            return OutlierRule(name, float(rest))
        if name == "radius":
            distance, _, within = rest.partition(",")
            parse_reach(distance, 1.0, units)
            if not within or int(within) >= 1:
                return OutlierRule(name, distance=distance, within=int(within or _LEAST_WITHIN))
    except ValueError:
        pass
    raise UsageError(
        f"The outlier mode {text!r} is unknown; expected one of {', '.join(MODES)}, statistical:DEVIATIONS, or "
        f"radius:DISTANCE,POINTS such as radius:3s,4."
    )


def outliers_by_rule(points: Float, rule: OutlierRule, units: str | None) -> Mask:
    """Return the mask, of shape (N,), of outliers by the statistical or the radius rule.

    Parameters
    ----------
    points : array of shape (N, 3), centred, distinct, N > 1
    rule : of one of these names
    units : the points' unit, where it is known
    """
    import open3d

    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    if rule.name == "statistical":
        stays = cloud.remove_statistical_outlier(_NEIGHBOURS + 1, rule.deviations)[1]
    else:
        reach = parse_reach(rule.distance, mean_spacing(points), units)
        # The library counts a point itself, and asks for more than the number.
        stays = cloud.remove_radius_outlier(rule.within, reach)[1]
    mask = np.ones(len(points), bool)
    mask[np.asarray(stays, np.intp)] = False
    return mask
