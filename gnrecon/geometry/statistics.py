"""Histograms, a robust standard deviation, and the widest gap between directions."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from gnrecon.geometry.arrays import Float


@dataclass(frozen=True)
class Histogram:
    """Counts of values in equal bins.

    Parameters
    ----------
    low, high : float
        Lower end of the first bin and upper end of the last, in the values' unit.
    counts : tuple of float
        Number of values, or their weight, in each bin; the last bin includes its upper end.
    below, above : float
        The same for values outside of the bins.
    """

    low: float
    high: float
    counts: tuple[float, ...]
    below: float = 0.0
    above: float = 0.0

    @classmethod
    def of(
        cls,
        values: npt.NDArray[np.floating[Any]],
        low: float,
        high: float,
        bins: int = 48,
        weights: npt.NDArray[np.floating[Any]] | None = None,
    ) -> Histogram:
        """Return the histogram of `values`, of shape (N,), with weights of shape (N,) or 1; NaN is not counted."""
        weights = np.ones(len(values)) if weights is None else weights
        counts = np.histogram(values, bins=bins, range=(low, high), weights=weights)[0]
        below, above = float(weights[values < low].sum()), float(weights[values > high].sum())
        return cls(float(low), float(high), tuple(counts.tolist()), below, above)

    @property
    def edges(self) -> Float:
        """Edges of the bins, of shape (bins + 1,)."""
        return np.linspace(self.low, self.high, len(self.counts) + 1)

    @property
    def total(self) -> float:
        """Sum of all counts, inside and outside of the bins."""
        return sum(self.counts) + self.below + self.above

    def as_dict(self) -> dict[str, Any]:
        """Return the fields as plain values, ready for JSON."""
        return {**asdict(self), "counts": list(self.counts)}


def robust_deviation(residuals: Float) -> float:
    """Return the standard deviation of centred residuals, of shape (N,), from their median absolute deviation.

    For a normal distribution the median of |r| is 0.6745 of the standard deviation; 1.4826 is the inverse.
    """
    return 1.4826 * float(np.median(np.abs(residuals)))


def perpendicular(axis: Float) -> Float:
    """Return vectors at right angles to axes, both of shape (..., 3); their lengths are not one."""
    across: Float = np.cross(axis, np.eye(3)[np.abs(axis).argmin(axis=-1)])
    return across


def widest_gap(directions: Float, axis: Float) -> float:
    """Return the widest angle about an axis, of shape (3,), that contains none of the directions, in radians.

    Parameters
    ----------
    directions : array of shape (N, 3)
        Their components along the axis are ignored; without directions the angle is a full turn.
    """
    if not len(directions):
        return 2 * np.pi
    across = perpendicular(axis)
    angles = np.sort(np.arctan2(directions @ np.cross(axis, across), directions @ across))
    return float(np.diff(np.append(angles, angles[0] + 2 * np.pi)).max())
