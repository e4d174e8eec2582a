"""Distances between samples of two surfaces, as they are published for the Surface Reconstruction Benchmark.

Points are drawn on both surfaces, uniformly by area, and each is measured to the nearest point of the other set.
Chamfer is half the sum of the two mean distances, Hausdorff the largest distance, both ways (Ben-Shabat et al. 2022,
DiGS). A distance to samples is never smaller than one to the surface: near zero it levels off at a share of their
spacing.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from gnrecon.export.metrics import sample_surface
from gnrecon.geometry.mesh import Mesh


def between_samples(mesh: Mesh, truth: Mesh, count: int, seed: int = 0) -> dict[str, float]:
    """Return ``samples_chamfer`` and ``samples_hausdorff`` of `count` samples a surface, in the meshes' unit."""
    rng = np.random.default_rng(seed)
    ours, theirs = (sample_surface(surface, count, rng).points for surface in (mesh, truth))
    there, back = cKDTree(ours).query(theirs)[0], cKDTree(theirs).query(ours)[0]
    return {
        "samples_chamfer": float(there.mean() + back.mean()) / 2,
        "samples_hausdorff": float(max(there.max(), back.max())),
    }
