"""Counts of values in equal bins, with what lies beyond them on either side."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from gnrecon.geometry.arrays import Float


@dataclass(frozen=True)
class Histogram:
    """How values spread.

    Parameters
    ----------
    low, high : float
        Where the first bin begins and the last one ends, in the values' unit.
    counts : tuple of float
        Values, or their weight, in each of the equal bins; the last bin holds its upper end too.
    below, above : float
        Likewise for what lies outside of the bins.
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
        """Count `values`, of shape (N,), each as one or by its weight, of shape (N,); NaN is not counted."""
        weights = np.ones(len(values)) if weights is None else weights
        counts = np.histogram(values, bins=bins, range=(low, high), weights=weights)[0]
        below, above = float(weights[values < low].sum()), float(weights[values > high].sum())
        return cls(float(low), float(high), tuple(counts.tolist()), below, above)

    @property
    def edges(self) -> Float:
        """Borders of the bins, of shape (bins + 1,)."""
        return np.linspace(self.low, self.high, len(self.counts) + 1)

    @property
    def total(self) -> float:
        """All that was counted, in the bins and beyond."""
        return sum(self.counts) + self.below + self.above

    def as_dict(self) -> dict[str, Any]:
        """Return the fields as plain values, ready for JSON."""
        return {**asdict(self), "counts": list(self.counts)}


# Statistics that a few outliers hardly move.


def deviation(off: Float) -> float:
    """Return the standard deviation of what is off its middle, of shape (N,), by the median of its size.

    It is that of a normal distribution of as large a median.
    """
    return 1.4826 * float(np.median(np.abs(off)))


# Angles about an axis.


def widest_gap(directions: Float, axis: Float) -> float:
    """Return the widest angle about an axis, of shape (3,), into which none of the directions looks, in radians.

    Parameters
    ----------
    directions : array of shape (N, 3)
        Their parts along the axis do not matter; without any the whole circle is bare.
    """
    if not len(directions):
        return 2 * np.pi
    across = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    angles = np.sort(np.arctan2(directions @ np.cross(axis, across), directions @ across))
    return float(np.diff(np.append(angles, angles[0] + 2 * np.pi)).max())
