#!/usr/bin/env python3
"""Makes the files of sample_data: meshes the shapes finely, scans them, and writes scans and thinned meshes.

Run it in the environment of the package: ``.venv/bin/python scripts/make_sample_data.py [FOLDER]``.
The seed fixes every file; another version of a library may change the last digits.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import manifold3d
import numpy as np
import open3d
from sample_shapes import SHAPES, Shape, project
from skimage.measure import marching_cubes
from virtual_scanner import Scanner, scan

from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.io import write_mesh


@dataclass(frozen=True)
class Sample:
    """One file: the shape's name, the scanner, the number of points, and whether normals are kept."""

    shape: str
    scanner: Scanner
    count: int
    normals: bool = True


SAMPLES = {
    "bracket_dense.ply": Sample("bracket", Scanner(), 20_000),
    "bracket_sparse.ply": Sample("bracket", Scanner(), 4_000),
    "knot_noisy.ply": Sample("knot", Scanner(noise=0.005, reach=3, outliers=0.03), 15_000),
    "knot_unoriented.xyz": Sample("knot", Scanner(), 10_000, normals=False),
}


def mesh_shape(shape: Shape, *, spacing: float = 0.6) -> Mesh:
    """Return the zero level of a shape by marching cubes, its vertices projected onto the surface.

    The grid's points are `spacing` millimetres apart.
    """
    axes = [np.arange(low, high + spacing, spacing) for low, high in zip(shape.low, shape.high, strict=True)]
    # A slab at a time, because the distance functions hold a dozen arrays of this size.
    slabs = [
        shape.distance(np.stack(np.meshgrid(slab, *axes[1:], indexing="ij"), axis=-1).reshape(-1, 3))
        for slab in np.array_split(axes[0], 16)
    ]
    values = np.concatenate(slabs).reshape([len(axis) for axis in axes])
    vertices, faces, _, _ = marching_cubes(  # type: ignore[no-untyped-call]
        values, 0.0, spacing=(spacing,) * 3
    )
    return Mesh(project(shape.distance, vertices + np.array(shape.low)), faces)


def thin(mesh: Mesh, shape: Shape, *, tolerance: float = 0.08) -> Mesh:
    """Return the mesh with all edges collapsed that move no face by more than `tolerance` mm, and projected again."""
    # Collapses by quadric error alone, as open3d's, fold plane faces over their own holes.
    full = manifold3d.Manifold(manifold3d.Mesh64(mesh.vertices, mesh.faces.astype(np.uint64)))
    few = full.simplify(tolerance).to_mesh64()
    return Mesh(project(shape.distance, few.vert_properties), few.tri_verts.astype(np.int64))


def write_scan(cloud: PointCloud, path: Path) -> None:
    """Write a cloud as text of three columns (.xyz), or as binary PLY of float32 with its normals."""
    if path.suffix == ".xyz":
        np.savetxt(path, cloud.points, fmt="%.3f")
        return
    tensors = open3d.t.geometry.PointCloud(open3d.core.Tensor.from_numpy(cloud.points.astype(np.float32)))
    if cloud.normals is not None:
        tensors.point.normals = open3d.core.Tensor.from_numpy(cloud.normals.astype(np.float32))
    open3d.t.io.write_point_cloud(path, tensors)


def main(folder: Path, *, seed: int = 20_260) -> None:
    """Write every file into `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    meshes = {name: mesh_shape(shape) for name, shape in SHAPES.items()}
    for name, mesh in meshes.items():
        write_mesh(thin(mesh, SHAPES[name]), folder / f"{name}_reference.ply", overwrite=True)
    for number, (file, sample) in enumerate(SAMPLES.items()):
        cloud = scan(meshes[sample.shape], sample.scanner, sample.count, np.random.default_rng([seed, number]))
        write_scan(cloud if sample.normals else cloud.with_normals(None), folder / file)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).resolve().parents[1] / "sample_data")
