"""A scan through an open3d script: read and thinned by open3d, reconstructed by gnrecon, and judged by open3d again.

python examples/open3d_pipeline.py sample_data/bracket_dense.ply mesh.ply --voxel 1.5
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import open3d

import gnrecon


@dataclass(frozen=True)
class Comparison:
    """How far the scan's points lie from the mesh, in the scan's unit, and whether open3d takes the mesh for closed."""

    points: int
    used: int
    mean: float
    largest: float
    watertight: bool


def pipeline(scan: Path, mesh: Path, voxel: float, **options: Any) -> Comparison:
    """Write the mesh of a scan that is thinned to one point a voxel, and compare it with all of the scan's points."""
    cloud = open3d.io.read_point_cloud(scan)
    thinned = cloud.voxel_down_sample(voxel)
    result = gnrecon.reconstruct(thinned, **options)  # open3d's cloud in, its normals and colours with it
    result.save(mesh, overwrite=True)  # read back and verified
    surface = result.to_open3d()  # open3d's mesh out
    distances = _distances(surface, np.asarray(cloud.points))
    return Comparison(
        points=len(cloud.points),
        used=len(thinned.points),
        mean=float(distances.mean()),
        largest=float(distances.max()),
        watertight=bool(surface.is_watertight()),
    )


def _distances(surface: Any, points: np.ndarray[Any, np.dtype[np.float64]]) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Distances of points, of shape (N, 3), from a surface, by open3d's ray-casting scene."""
    # It computes in single precision, so about the middle of the surface.
    middle = surface.get_center()
    core: Any = open3d.core
    scene: Any = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        core.Tensor((np.asarray(surface.vertices) - middle).astype(np.float32)),
        core.Tensor(np.asarray(surface.triangles).astype(np.uint32)),
    )
    return np.asarray(scene.compute_distance(core.Tensor((points - middle).astype(np.float32))).numpy(), np.float64)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the pipeline as the arguments say, and print the comparison."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("scan", type=Path, help="a cloud that open3d reads")
    parser.add_argument("mesh", type=Path, help="the mesh to write")
    parser.add_argument("--voxel", type=float, required=True, help="side of the voxels, in the scan's unit")
    parser.add_argument("--resolution", type=int, help="cells along the longest side")
    chosen = parser.parse_args(arguments)
    found = pipeline(chosen.scan, chosen.mesh, chosen.voxel, resolution=chosen.resolution)
    print(
        f"{chosen.mesh}: of {found.used} of {found.points} points, {'' if found.watertight else 'not '}watertight; the "
        f"points lie {found.mean:.3g} from it on average, and {found.largest:.3g} at most."
    )


if __name__ == "__main__":
    main()
