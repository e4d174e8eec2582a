"""One reconstruction with its uncertainty, beside the true errors of its vertices."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from scipy.stats import spearmanr

from benchmarks.uncertainty.scans import Case, draw, errors
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.pipeline import Reconstruction, reconstruct

FAR = 2.0
"""In spacings of the points: vertices that lie farther from them count as those of holes."""


@dataclass(frozen=True)
class Check:
    """A scan, what was made of it, and the true error of each vertex, of shape (V,), in the unit of the scan."""

    scan: PointCloud
    result: Reconstruction
    error: Float

    @property
    def sigma(self) -> Float:
        """Of each vertex."""
        return np.asarray(self.result.mesh.attributes["sigma"], dtype=np.float64)

    @property
    def distance(self) -> Float:
        """From each vertex to the nearest point."""
        return np.asarray(self.result.mesh.attributes["distance"], dtype=np.float64)


def run(case: Case, seed: int, options: dict[str, Any]) -> Check:
    """Reconstruct the scan of a case."""
    scan = draw(case, seed)
    result = reconstruct(scan, uncertainty=True, attributes="distance", outliers="off", seed=seed, **options)
    return Check(scan, result, errors(case, result.mesh.vertices))


def figures(check: Check) -> dict[str, Any]:
    """Return shares within two sigma, rank correlations with the error, and sizes in 1e-3 of the radius."""
    uncertainty = check.result.uncertainty
    assert uncertainty is not None, "it was asked for"
    scale = 1e3 / check.result.sdf.frame.scale
    sigma, error = check.sigma, check.error
    far = check.distance > FAR * spacing(check.scan)
    stages = {stage["name"]: stage["seconds"] for stage in check.result.report["stages"]}
    return {
        "points": len(check.scan),
        "vertices": len(error),
        "within": _share(error <= 2 * sigma),
        "within_near": _share((error <= 2 * sigma)[~far]),
        "within_far": _share((error <= 2 * sigma)[far]),
        "far": _share(far),
        "rank": float(spearmanr(sigma, error).statistic),
        "rank_of_distance": float(spearmanr(check.distance, error).statistic),
        "median_sigma": scale * float(np.median(sigma)),
        "median_error": scale * float(np.median(error)),
        "factor": uncertainty.factor,
        "noise": scale * uncertainty.noise,
        "seconds": stages["attributes"],
        "seconds_of_all": sum(stages.values()),
    }


def spacing(scan: PointCloud) -> float:
    """Return the median distance from a point to its nearest neighbour."""
    return float(np.median(cKDTree(scan.points).query(scan.points, k=2)[0][:, 1]))


def _share(mask: Any) -> float | None:
    return float(np.mean(mask)) if len(mask) else None
