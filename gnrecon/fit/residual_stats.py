"""How well a fitted field explains its points: its value there, and the angle between its gradient and their normals.

These are the residuals of `f = 0` and of the normals in a reader's units. For an exact signed distance, both vanish. A
noisy scan leaves residuals as large as its noise, and smaller ones say that noise was fitted.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from gnrecon.fit.field_model import NeuralSDF
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.point_cloud import Samples
from gnrecon.geometry.statistics import Histogram

MOST = 20_000
"""Points that are asked; more would cost time and change no figure."""

SHOWN = 99.0
"""Percentile of the values that the histograms reach to."""


@dataclass(frozen=True)
class Misfit:
    """Residuals at points of the fit.

    Parameters
    ----------
    distances : array of shape (N,), file units
        Values of the field: how far outside (positive) or inside of the surface each point lies, to first order.
    angles : array of shape (N,), degrees
        Between the field's gradient and the point's normal.
    """

    distances: Float
    angles: Float

    @classmethod
    def of(cls, sdf: NeuralSDF, samples: Samples) -> Misfit:
        """Measure the residuals at `samples`, or at every so-manieth of them where they are more than `MOST`."""
        rows = slice(None, None, -(-len(samples) // MOST))
        points, normals = samples.frame.to_world(samples.points[rows]), samples.normals[rows]
        cosines = np.einsum("ij,ij->i", sdf.normals(points), normals)
        return cls(sdf.sdf(points), np.degrees(np.arccos(np.clip(cosines, -1, 1))))

    def describe(self) -> str:
        """Return a sentence with the distances, in file units, and the angles."""
        sizes = np.abs(self.distances)
        return (
            f"distances {sizes.mean():.3g} on the mean, {np.percentile(sizes, 95):.3g} for 95 % of them, "
            f"{sizes.max():.3g} at most; normals {np.median(self.angles):.1f} degrees off in the median."
        )

    def as_dict(self) -> dict[str, Any]:
        """Return the figures and a histogram of each residual, ready for JSON."""
        reach = _reach(np.abs(self.distances))
        return {
            "points": len(self.distances),
            "contradicted": float((self.angles > 90).mean()),
            "distance": _figures(np.abs(self.distances)) | {"histogram": _counts(self.distances, -reach, reach)},
            "angle": _figures(self.angles) | {"histogram": _counts(self.angles, 0.0, _reach(self.angles))},
        }


def _figures(sizes: Float) -> dict[str, float]:
    return {
        "mean": float(sizes.mean()),
        "rms": float(np.sqrt(np.mean(sizes**2))),
        "median": float(np.median(sizes)),
        "p95": float(np.percentile(sizes, 95)),
        "max": float(sizes.max()),
    }


def _reach(sizes: Float) -> float:
    """Where a histogram of sizes of shape (N,) ends; any positive number where all are zero, or not finite."""
    reach = float(np.percentile(sizes, SHOWN))
    return reach if 0 < reach < np.inf else 1.0


def _counts(values: Float, low: float, high: float) -> dict[str, Any]:
    return Histogram.of(values, low, high).as_dict()
