"""Outliers by the two rules that are in wide use, by open3d, for those who want exactly these.

- *statistical*: the mean distance to the 16 nearest points is more than so many standard deviations above its mean
  over the cloud (Rusu et al. 2008);
- *radius*: fewer than so many other points lie within a distance.

Both take a region that was scanned thinly for outliers, so that they are not the default, see `outliers`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gnrecon.geometry.arrays import Float, Mask
from gnrecon.geometry.units import parse_reach
from gnrecon.ingest.spacing import mean_spacing
from gnrecon.runtime.errors import UsageError

MODES = ("auto", "on", "off")
_NEIGHBOURS = 16
_DEVIATIONS = 2.0
_LEAST_WITHIN = 4


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
    deviations: float = _DEVIATIONS
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
