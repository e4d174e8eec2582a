"""The analytic shapes: solids that are known exactly, of radius one about the origin.

Some have plane faces and sharp edges: manifold3d makes them from boxes and extruded outlines, and the mesh is the
shape. The others are zero levels of functions: a mesh approximates them to a few hundred-thousandths, and points drawn
from it are projected onto the zero level by Newton's method.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from sample_shapes import Distance, gradient, project, smooth_cut

from gnrecon.export import extract
from gnrecon.export.metrics import sample_surface
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import Frame


@dataclass(frozen=True)
class Solid:
    """A shape.

    Parameters
    ----------
    mesh : function that returns the surface as a fine mesh, closed and oriented outward
    genus : of the surface, which has one component
    function : the function whose zero level is the surface, negative inside; None where the mesh is the surface
    """

    mesh: Callable[[], Mesh]
    genus: int
    function: Distance | None = None

    def draw(self, count: int, rng: np.random.Generator, *, step: float = 1e-5) -> tuple[Float, Float]:
        """Return points on the surface, uniform by area, and their outward unit normals, both of shape (N, 3).

        `step` is the one of the central differences, in radii.
        """
        samples = sample_surface(self.mesh(), count, rng)
        if self.function is None:
            assert samples.normals is not None, "a mesh has normals"
            return samples.points, samples.normals
        points = project(self.function, samples.points)
        slopes = gradient(self.function, points, step)
        return points, slopes / np.linalg.norm(slopes, axis=1, keepdims=True)


@dataclass(frozen=True)
class FunctionField:
    """A function as a field that gnrecon can mesh (`gnrecon.export.SignedDistance`).

    Parameters
    ----------
    function : of points of shape (N, 3), negative inside
    half_side : of the cube around the origin that is meshed
    step : of the central differences of the gradient
    """

    function: Distance
    half_side: float = 1.0
    step: float = 1e-5

    @property
    def frame(self) -> Frame:
        """The unit frame."""
        return Frame(np.zeros(3), 1.0)

    @property
    def bounds(self) -> Float:
        """Corners of the cube, of shape (2, 3)."""
        return np.array([[-self.half_side] * 3, [self.half_side] * 3])

    def sdf(self, points: Float) -> Float:
        """Return values, of shape (N,), at points, of shape (N, 3)."""
        return self.function(points)

    def gradient(self, points: Float) -> Float:
        """Return gradients, of shape (N, 3), at points, of shape (N, 3)."""
        return gradient(self.function, points, self.step)


def _zero_level(function: Distance, *, cells: int = 256) -> Callable[[], Mesh]:
    """Return the function that meshes the zero level of another within the unit ball; `cells` along the box."""

    @cache
    def mesh() -> Mesh:
        rough = extract(FunctionField(function, half_side=1.03), resolution=cells)
        return rough.with_vertices(project(function, rough.vertices))

    return mesh


def _manifold(build: Callable[[Any], Any], *, longest_edge: float = 0.02) -> Callable[[], Mesh]:
    """Return the function that meshes a solid of `build`, which it makes with manifold3d, scaled to radius one.

    Edges are at most `longest_edge` radii, because long slivers would be drawn with smeared shades.
    """

    @cache
    def mesh() -> Mesh:
        import manifold3d

        data = build(manifold3d)
        vertices = data.to_mesh64().vert_properties[:, :3]
        radius = float(np.linalg.norm(vertices, axis=1).max())
        data = data.scale([1 / radius] * 3).refine_to_length(longest_edge).to_mesh64()
        # A copy, because manifold3d complains at exit about views of its memory.
        return Mesh(np.array(data.vert_properties[:, :3]), data.tri_verts.astype(np.int64))

    return mesh


def sphere(points: Float) -> Float:
    """Return the distance to the unit sphere."""
    return np.asarray(np.linalg.norm(points, axis=1) - 1.0)


def torus(points: Float) -> Float:
    """Return the distance to a torus about the z axis."""
    return np.hypot(np.hypot(points[:, 0], points[:, 1]) - 0.7, points[:, 2]) - 0.3


def gyroid(points: Float) -> Float:
    """Return a first-order distance to a wall along the gyroid, 0.14 thick, within the unit ball, its rim rounded."""
    wave = 2 * np.pi / 1.4
    s, c = np.sin(wave * points), np.cos(wave * points)
    middle = (s[:, 0] * c[:, 1] + s[:, 1] * c[:, 2] + s[:, 2] * c[:, 0]) / (1.5 * wave)
    return smooth_cut(np.abs(middle) - 0.07, 1.0 - np.linalg.norm(points, axis=1), 0.06)


def _block(m: Any) -> Any:
    """A cube with a square channel along each axis; the three meet in its middle."""
    channels = [m.Manifold.cube(size, True) for size in ([3.0, 0.8, 0.8], [0.8, 3.0, 0.8], [0.8, 0.8, 3.0])]
    return m.Manifold.cube([2.0, 2.0, 2.0], True) - m.Manifold.batch_boolean(channels, m.OpType.Add)


def _plate(m: Any) -> Any:
    """A plate of a fiftieth of its length."""
    return m.Manifold.cube([1.0, 0.7, 0.02], True)


def _gear(m: Any) -> Any:
    """A gear of fourteen straight-flanked teeth with a bore, a keyway and five lightening holes."""
    teeth, root, tip = 14, 0.80, 1.0
    turns = np.concatenate([np.array([-0.30, -0.14, 0.14, 0.30]) + tooth for tooth in range(teeth)])
    reach = np.tile([root, tip, tip, root], teeth)
    angles = 2 * np.pi * turns / teeth
    outline = m.CrossSection([np.stack([reach * np.cos(angles), reach * np.sin(angles)], axis=1)])
    bore = m.CrossSection.circle(0.22, 96) + m.CrossSection.square([0.12, 0.3]).translate([-0.06, 0.0])
    holes = [
        m.CrossSection.circle(0.13, 64).translate([0.52 * np.cos(a), 0.52 * np.sin(a)])
        for a in 2 * np.pi * (np.arange(5) + 0.25) / 5
    ]
    section = outline - m.CrossSection.batch_boolean([bore, *holes], m.OpType.Add)
    return m.Manifold.extrude(section, 0.36).translate([0.0, 0.0, -0.18])


def _stand(m: Any) -> Any:
    """Three thin plates that meet at slanting angles: a foot with a notch, a back with a round hole, and a shelf."""
    foot = m.Manifold.cube([1.2, 1.0, 0.05], True).translate([0.0, 0.0, -0.5])
    back = m.Manifold.cube([0.05, 1.0, 1.0], True).rotate([0.0, 20.0, 0.0]).translate([0.1, 0.0, -0.05])
    shelf = m.Manifold.cube([0.3, 1.0, 0.05], True).rotate([0.0, 20.0, 0.0]).translate([-0.05, 0.0, -0.25])
    notch = m.Manifold.cube([0.5, 0.3, 0.3], True).translate([0.35, 0.0, -0.5])
    hole = m.Manifold.cylinder(2.0, 0.15, 0.15, 96, True).rotate([0.0, 90.0, 0.0]).translate([0.0, 0.0, 0.1])
    return m.Manifold.batch_boolean([foot, back, shelf], m.OpType.Add) - notch - hole


def _housing(m: Any) -> Any:
    """A box without a lid: bored posts in its four corners, a bored boss on its floor, a hole in two of its walls."""
    solid = m.Manifold.cube([1.8, 1.4, 0.7], True) - m.Manifold.cube([1.6, 1.2, 0.7], True).translate([0.0, 0.0, 0.1])
    for x, y in ((-0.65, -0.45), (-0.65, 0.45), (0.65, -0.45), (0.65, 0.45)):
        solid += m.Manifold.cylinder(0.5, 0.13, 0.13, 96, True).translate([x, y, -0.1])
        solid -= m.Manifold.cylinder(1.2, 0.06, 0.06, 96, True).translate([x, y, 0.0])
    solid += m.Manifold.cylinder(0.3, 0.35, 0.35, 96, True).translate([0.0, 0.0, -0.2])
    solid -= m.Manifold.cylinder(2.0, 0.2, 0.2, 96, True)
    return solid - m.Manifold.cylinder(3.0, 0.12, 0.12, 96, True).rotate([90.0, 0.0, 0.0]).translate([0.3, 0.0, 0.1])


SOLIDS = {
    "sphere": Solid(_zero_level(sphere), genus=0, function=sphere),
    "torus": Solid(_zero_level(torus), genus=1, function=torus),
    "block": Solid(_manifold(_block), genus=5),
    "plate": Solid(_manifold(_plate), genus=0),
    "gear": Solid(_manifold(_gear), genus=6),
    "gyroid": Solid(_zero_level(gyroid), genus=10, function=gyroid),
    "stand": Solid(_manifold(_stand), genus=1),
    "housing": Solid(_manifold(_housing), genus=7),
}
