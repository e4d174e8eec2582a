#!/usr/bin/env python3
"""Makes the design problem of sample_data: a small bracket's design region and its interfaces, in millimetres.

The part is to carry a pin through two bolted feet. The region is the convex hull of a foot block and a lug, with a slab
for the feet, less the holes and room for the bolts' heads. The interfaces are the walls of the two bolt holes and of
the pin's bore, open tubes whose faces look into the hole.

Run it in the environment of the package: ``.venv/bin/python scripts/make_sample_design.py [FOLDER]``.
"""

from __future__ import annotations

import sys
from pathlib import Path

import manifold3d
import numpy as np
from manifold3d import CrossSection, Manifold

from gnrecon.geometry.mesh import Mesh
from gnrecon.io import write_mesh

SEGMENTS, ROWS = 64, 5
BOLTS, BOLT_RADIUS, FOOT, HEAD_RADIUS = (-40.0, 40.0), 6.0, 14.0, 11.0
PIN_HEIGHT, PIN_RADIUS, LUG_RADIUS, HALF_WIDTH = 52.0, 10.0, 22.0, 18.0


def upright(radius: float, low: float, high: float) -> Manifold:
    """Return a cylinder along z."""
    return Manifold.cylinder(high - low, radius, circular_segments=SEGMENTS).translate((0.0, 0.0, low))


def lying(radius: float, half_length: float) -> Manifold:
    """Return a cylinder along y through the middle of the pin."""
    along_y = upright(radius, -half_length, half_length).rotate((90.0, 0.0, 0.0))
    return along_y.translate((0.0, 0.0, PIN_HEIGHT))


def region() -> Manifold:
    """Return the design region."""
    rounded = CrossSection.square((76.0, 16.0), center=True).offset(
        14.0, manifold3d.JoinType.Round, circular_segments=SEGMENTS
    )
    slab = rounded.extrude(FOOT)
    foot = Manifold.cube((70.0, 2 * HALF_WIDTH, FOOT)).translate((-35.0, -HALF_WIDTH, 0.0))
    body = Manifold.batch_hull([foot, lying(LUG_RADIUS, HALF_WIDTH)]) + slab
    for x in BOLTS:
        hole, head = upright(BOLT_RADIUS, -1.0, FOOT + 1.0), upright(HEAD_RADIUS, FOOT, 90.0)
        body = body - (hole + head).translate((x, 0.0, 0.0))
    return body - lying(PIN_RADIUS, HALF_WIDTH + 1.0)


def tube(radius: float, low: float, high: float) -> Mesh:
    """Return the wall of a hole along z, its faces looking inward."""
    turn = 2 * np.pi * np.arange(SEGMENTS) / SEGMENTS
    ring = radius * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    heights = np.linspace(low, high, ROWS)
    vertices = np.concatenate([np.column_stack([ring, np.full(SEGMENTS, z)]) for z in heights])
    row, column = (index.ravel() for index in np.meshgrid(np.arange(ROWS - 1), np.arange(SEGMENTS), indexing="ij"))
    here, beside = row * SEGMENTS + column, row * SEGMENTS + (column + 1) % SEGMENTS
    above, across = here + SEGMENTS, beside + SEGMENTS
    return Mesh(vertices, np.concatenate([np.stack([here, across, beside], 1), np.stack([here, above, across], 1)]))


def interfaces() -> Mesh:
    """Return the walls of the bolt holes and of the bore, as three open pieces."""
    bolt, bore = tube(BOLT_RADIUS, 0.0, FOOT), tube(PIN_RADIUS, -HALF_WIDTH, HALF_WIDTH).vertices
    # A quarter turn about x takes z to y and y to -z, as the region's bore was turned.
    pieces = [bolt.vertices + np.array([x, 0.0, 0.0]) for x in BOLTS]
    pieces.append(bore @ np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]]) + np.array([0.0, 0.0, PIN_HEIGHT]))
    faces = [bolt.faces + number * len(bolt.vertices) for number in range(len(pieces))]
    return Mesh(np.concatenate(pieces), np.concatenate(faces))


def as_mesh(solid: Manifold) -> Mesh:
    """Return a solid's surface."""
    mesh = solid.to_mesh64()
    return Mesh(mesh.vert_properties[:, :3], mesh.tri_verts.astype(np.int64))


def main(folder: Path) -> None:
    """Write both files into `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    write_mesh(as_mesh(region()), folder / "design_region.stl", overwrite=True)
    write_mesh(interfaces(), folder / "design_interfaces.stl", overwrite=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).resolve().parents[1] / "sample_data")
