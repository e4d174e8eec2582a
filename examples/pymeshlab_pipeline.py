"""Clean a cloud with pymeshlab, reconstruct it, and smooth the mesh with pymeshlab.

    python examples/pymeshlab_pipeline.py sample_data/bracket_dense.ply mesh.ply --points 5000

Nothing is written in between: gnrecon takes pymeshlab's mesh set and returns one.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pymeshlab

import gnrecon


def pipeline(scan: Path, mesh: Path, points: int, **options: Any) -> dict[str, Any]:
    """Write the mesh of a scan that is thinned to a number of points; return MeshLab's measures of its topology."""
    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.load_new_mesh(str(scan))
    if meshes.current_mesh().vertex_number() > points:
        meshes.generate_simplified_point_cloud(samplenum=points)  # a Poisson-disk sample
    result = gnrecon.reconstruct(meshes, **options)  # pymeshlab's current mesh in, its normals and colours with it
    made = result.to_pymeshlab()  # and a mesh set out
    made.apply_coord_taubin_smoothing(stepsmoothnum=3)
    smoothed = gnrecon.as_mesh(made)
    gnrecon.require_sound(smoothed)  # smoothing moved vertices: it is verified again
    gnrecon.write_mesh(smoothed, mesh, overwrite=True)
    return dict(made.get_topological_measures())


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the pipeline as the arguments say, and print MeshLab's measures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("scan", type=Path, help="a cloud that pymeshlab reads")
    parser.add_argument("mesh", type=Path, help="the mesh to write")
    parser.add_argument("--points", type=int, default=20_000, help="points to keep")
    parser.add_argument("--resolution", type=int, help="cells along the longest side")
    chosen = parser.parse_args(arguments)
    found = pipeline(chosen.scan, chosen.mesh, chosen.points, resolution=chosen.resolution)
    print(
        f"{chosen.mesh}: {found['vertices_number']} vertices, {found['boundary_edges']} boundary edges, "
        f"genus {found['genus']}."
    )


if __name__ == "__main__":
    main()
