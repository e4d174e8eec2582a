#!/usr/bin/env python3
"""Makes the design problem of sample_data: a small bracket's design region and its interfaces, in millimetres.

The part carries a pin on two bolted feet. The region is the convex hull of a foot block and a lug, with a slab
for the feet, minus the holes and the space of the bolt heads. The interfaces are the walls of the two bolt holes and of
the pin's bore, open tubes whose faces point into the hole.

Run it in the environment of the package: ``.venv/bin/python scripts/make_sample_design.py [FOLDER]``.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import manifold3d
import numpy as np
from manifold3d import CrossSection, Manifold

from gnrecon.geometry.mesh import Mesh
from gnrecon.io import write_mesh


@dataclass(frozen=True)
class BracketDesign:
    """Dimensions of the part and its region, in millimetres, and the segments and rows of a tube's faces."""

    bolt_offset: float = 40.0
    bolt_radius: float = 6.0
    head_radius: float = 11.0
    foot_height: float = 14.0
    pin_height: float = 52.0
    pin_radius: float = 10.0
    lug_radius: float = 22.0
    half_width: float = 18.0
    segments: int = 64
    rows: int = 5

    def region(self) -> Manifold:
        """Return the design region."""
        rounded = CrossSection.square((76.0, 16.0), center=True).offset(
            14.0, manifold3d.JoinType.Round, circular_segments=self.segments
        )
        slab = rounded.extrude(self.foot_height)
        foot = Manifold.cube((70.0, 2 * self.half_width, self.foot_height)).translate((-35.0, -self.half_width, 0.0))
        body = Manifold.batch_hull([foot, self._along_y(self.lug_radius, self.half_width)]) + slab
        for x in (-self.bolt_offset, self.bolt_offset):
            hole = self._along_z(self.bolt_radius, -1.0, self.foot_height + 1.0)
            head = self._along_z(self.head_radius, self.foot_height, 90.0)
            body = body - (hole + head).translate((x, 0.0, 0.0))
        return body - self._along_y(self.pin_radius, self.half_width + 1.0)

    def interfaces(self) -> Mesh:
        """Return the walls of the bolt holes and of the bore, as three open pieces."""
        bolt = self._tube(self.bolt_radius, 0.0, self.foot_height)
        bore = self._tube(self.pin_radius, -self.half_width, self.half_width).vertices
        # A quarter turn about x takes z to y and y to -z, as the region's bore was turned.
        pieces = [bolt.vertices + np.array([x, 0.0, 0.0]) for x in (-self.bolt_offset, self.bolt_offset)]
        pieces.append(bore @ np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]]) + np.array([0.0, 0.0, self.pin_height]))
        faces = [bolt.faces + number * len(bolt.vertices) for number in range(len(pieces))]
        return Mesh(np.concatenate(pieces), np.concatenate(faces))

    def _along_z(self, radius: float, low: float, high: float) -> Manifold:
        """Return a cylinder along z."""
        cylinder = Manifold.cylinder(high - low, radius, circular_segments=self.segments)
        return cylinder.translate((0.0, 0.0, low))

    def _along_y(self, radius: float, half_length: float) -> Manifold:
        """Return a cylinder along y through the middle of the pin."""
        turned = self._along_z(radius, -half_length, half_length).rotate((90.0, 0.0, 0.0))
        return turned.translate((0.0, 0.0, self.pin_height))

    def _tube(self, radius: float, low: float, high: float) -> Mesh:
        """Return the wall of a hole along z, its faces pointing inward."""
        turn = 2 * np.pi * np.arange(self.segments) / self.segments
        ring = radius * np.stack([np.cos(turn), np.sin(turn)], axis=1)
        heights = np.linspace(low, high, self.rows)
        vertices = np.concatenate([np.column_stack([ring, np.full(self.segments, z)]) for z in heights])
        row, column = (
            index.ravel() for index in np.meshgrid(np.arange(self.rows - 1), np.arange(self.segments), indexing="ij")
        )
        a, b = row * self.segments + column, row * self.segments + (column + 1) % self.segments
        c, d = a + self.segments, b + self.segments
        return Mesh(vertices, np.concatenate([np.stack([a, d, b], 1), np.stack([a, c, d], 1)]))


def as_mesh(solid: Manifold) -> Mesh:
    """Return a solid's surface."""
    mesh = solid.to_mesh64()
    return Mesh(mesh.vert_properties[:, :3], mesh.tri_verts.astype(np.int64))


def main(folder: Path) -> None:
    """Write both files into `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    design = BracketDesign()
    write_mesh(as_mesh(design.region()), folder / "design_region.stl", overwrite=True)
    write_mesh(design.interfaces(), folder / "design_interfaces.stl", overwrite=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).resolve().parents[1] / "sample_data")
