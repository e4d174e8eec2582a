"""Reconstruct a cloud that pyvista holds, colour the mesh by its distance from the points, and draw a picture.

    python examples/pyvista_pipeline.py sample_data/bracket_dense.ply mesh.vtp --picture mesh.png

pyvista is not needed by gnrecon: ``pip install pyvista``. On a machine without a display the picture needs VTK's
off-screen rendering, which its wheels have.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pyvista

import gnrecon


def pipeline(scan: Path, mesh: Path, picture: Path | None = None, **options: Any) -> Any:
    """Write the mesh of a scan as VTK's ``.vtp``, and perhaps a picture; return the mesh as pyvista's PolyData."""
    cloud = pyvista.read(scan)
    result = gnrecon.reconstruct(cloud, **options)  # pyvista's data set in, its normals and arrays with it
    surface = result.to_pyvista()  # and PolyData out, with gnrecon's attributes as point data
    surface.save(mesh)
    if picture is not None:
        plotter = pyvista.Plotter(off_screen=True)
        plotter.add_mesh(surface, scalars="distance", cmap="viridis")
        plotter.add_mesh(cloud, color="black", point_size=2)
        plotter.screenshot(picture)
        plotter.close()
    return surface


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the pipeline as the arguments say, and print what the mesh is."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("scan", type=Path, help="a cloud that pyvista reads")
    parser.add_argument("mesh", type=Path, help="the .vtp file to write")
    parser.add_argument("--picture", type=Path, help="a PNG file to write")
    parser.add_argument("--resolution", type=int, help="cells along the longest side")
    chosen = parser.parse_args(arguments)
    surface = pipeline(chosen.scan, chosen.mesh, chosen.picture, resolution=chosen.resolution)
    print(f"{chosen.mesh}: {surface.n_points} vertices, {'' if surface.is_manifold else 'not '}manifold.")


if __name__ == "__main__":
    main()
