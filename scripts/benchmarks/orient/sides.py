"""How many estimated normals are on the right side, and how far off their directions are: gnrecon's and open3d's."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.peers import oriented
from benchmarks.problem import Problem
from gnrecon.export.metrics import SurfaceQuery
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.mesh import Mesh
from gnrecon.ingest import oriented_normals


def true_normals(problem: Problem) -> Float | None:
    """Return the outward unit normals of a scan: its own, or the true surface's next to it; None where neither is."""
    normals = problem.scan.normals
    if normals is None and isinstance(problem.truth, Mesh):
        _, faces = SurfaceQuery(problem.truth).nearest(problem.scan.points)
        normals = problem.truth.face_vectors[faces]
    return None if normals is None else normals / np.linalg.norm(normals, axis=1, keepdims=True)


def sides(problem: Problem) -> dict[str, Any]:
    """Return the figures of both estimates; those that need a truth are None where there is none."""
    truth, points = true_normals(problem), problem.scan.points
    points, first = np.unique(points, axis=0, return_index=True)
    confidence = 0.0

    def ours() -> Float:
        nonlocal confidence
        found = oriented_normals(points)
        confidence = found.confidence or 0.0
        return found.normals

    def theirs() -> Float:
        return np.asarray(oriented(points, None, outliers=False).normals)

    told = {"points": len(points), "gnrecon": _figures(ours, truth, first), "open3d": _figures(theirs, truth, first)}
    return told | {"confidence": confidence}


def _figures(estimate: Callable[[], Float], truth: Float | None, rows: Any) -> dict[str, Any]:
    start = time.process_time()
    normals = estimate()
    seconds = time.process_time() - start
    if truth is None:
        return {"right": None, "angle_mean": None, "cpu_seconds": seconds}
    cosines = np.einsum("ij,ij->i", normals, truth[rows])
    # open3d leaves the side of the whole to chance, and a user would see and turn it.
    right = float(max((cosines > 0).mean(), (cosines < 0).mean()))
    angles = np.degrees(np.arccos(np.clip(np.abs(cosines), 0, 1)))
    return {"right": right, "angle_mean": float(angles.mean()), "cpu_seconds": seconds}
