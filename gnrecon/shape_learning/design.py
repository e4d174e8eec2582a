"""A design problem from two files, in unit coordinates, and how well a mesh satisfies it.

The frame is that of the design region: the centre of its box is the origin and half its longest side is one. Interfaces
are usually in the same coordinates as the region. If not, as for the paper's bracket (millimetres, while its region is
normalised), a separate frame maps them: x = (file - origin) / scale.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gnrecon.export.boolean import from_solid, to_solid
from gnrecon.export.mesh_statistics import face_components, submesh
from gnrecon.export.metrics import SurfaceQuery, nearest_on_surface, sample_surface
from gnrecon.export.verify import failures, verify
from gnrecon.geometry.arrays import Float, Int, Mask
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import Frame
from gnrecon.geometry.signed_distance import Box
from gnrecon.io import read_mesh
from gnrecon.runtime.errors import InputError


@dataclass(frozen=True)
class Design:
    """A design region and the interfaces to which a part is attached, both in unit coordinates.

    Parameters
    ----------
    region : DesignRegion
    interfaces : Interfaces
    frame : Frame
        Between the coordinates of the region's file and unit ones.
    """

    region: DesignRegion
    interfaces: Interfaces
    frame: Frame


def read_design(
    region: str | Path, interfaces: str | Path, interfaces_frame: Frame | None = None, *, margin: float = 0.1
) -> Design:
    """Read a design problem.

    Parameters
    ----------
    region : file of a closed mesh: the design region
    interfaces : file of a mesh of open pieces whose faces look out of the part
    interfaces_frame : maps the coordinates of the interfaces' file to those of the region's file
    margin : distance from the region to the faces of the problem's box, in half the region's longest side

    Raises
    ------
    InputError
        When a file cannot be read, the region is not closed, or interfaces lie outside of its box.
    """
    envelope, walls = read_mesh(region), read_mesh(interfaces)
    if envelope.volume < 0:
        envelope = Mesh(envelope.vertices, envelope.faces[:, ::-1])
    faults = failures(verify(envelope))
    if faults:
        raise InputError(f"{region}: a design region must be a closed surface, but the mesh {faults[0]}.")
    if interfaces_frame is not None:
        walls = walls.with_vertices(interfaces_frame.to_unit(walls.vertices))
    low, high = envelope.vertices.min(axis=0), envelope.vertices.max(axis=0)
    frame = Frame((low + high) / 2, float((high - low).max()) / 2)
    walls = walls.with_vertices(frame.to_unit(walls.vertices))
    made = DesignRegion(_with_short_edges(envelope.with_vertices(frame.to_unit(envelope.vertices))), margin)
    _check_place(walls, made, interfaces)
    return Design(made, Interfaces(walls), frame)


def _with_short_edges(mesh: Mesh, *, longest_edge: float = 0.1) -> Mesh:
    """Return the same surface with no edge longer than `longest_edge`, in unit coordinates.

    The needle triangles of CAD systems are too thin for the nearest-point search in single precision, whose error would
    be a thousandth.
    """
    return from_solid(to_solid(mesh, merge=False).refine_to_length(longest_edge), mesh)


def _check_place(walls: Mesh, region: DesignRegion, path: str | Path, *, tolerance: float = 0.02) -> None:
    """Raise `InputError` if interfaces are outside of the region's box by more than `tolerance`."""
    beyond = np.maximum(region.mesh.vertices.min(axis=0) - walls.vertices, walls.vertices - region.mesh.vertices.max(0))
    if beyond.max() > tolerance:
        raise InputError(
            f"{path}: the interfaces reach {beyond.max():.3g} half-lengths of the design region beyond its box. If "
            "they have other coordinates, give their frame."
        )


class InterfaceSample(NamedTuple):
    """Points on interfaces.

    Parameters
    ----------
    points : of shape (N, 3)
    normals : unit, out of the part, of shape (N, 3)
    pieces : number of the interface that each belongs to, of shape (N,)
    """

    points: Float
    normals: Float
    pieces: Int


class Interfaces:
    """The interfaces of a part: surfaces that it must contain, with their normals, such as walls of bolt holes.

    Parameters
    ----------
    mesh : Mesh
        Unit coordinates; open, one connected piece for each interface; faces point out of the part, into the hole.
    """

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh

    @cached_property
    def pieces(self) -> list[Mesh]:
        """One mesh for each interface, in the order of their first faces."""
        labels = face_components(self.mesh)
        return [submesh(self.mesh, labels == label) for label in range(labels.max() + 1)]

    def __len__(self) -> int:
        return len(self.pieces)

    def sample(self, count: int, rng: np.random.Generator) -> InterfaceSample:
        """Draw about `count` points, the same number on each interface, so that small ones have equal weight."""
        each = max(1, round(count / len(self)))
        drawn = [sample_surface(piece, each, rng) for piece in self.pieces]
        normals = [sample.normals for sample in drawn if sample.normals is not None]
        numbers = np.repeat(np.arange(len(self)), each)
        return InterfaceSample(np.concatenate([sample.points for sample in drawn]), np.concatenate(normals), numbers)


@dataclass(frozen=True)
class DesignMeasurement:
    """How well a part's mesh satisfies its design; lengths are in half the region's longest side.

    Parameters
    ----------
    violations : share of its surface that is outside of the region by more than a tolerance; interfaces of holes, and
        parts attached to them, lie on the region's border
    depth : distance of the farthest sampled point outside of the region; 0 if there is none
    attachment : mean distance from the surface of the points of each interface
    components : solid pieces, without cavities
    """

    violations: float
    depth: float
    attachment: tuple[float, ...]
    components: int

    @property
    def mean_attachment(self) -> float:
        """Mean distance of all interfaces, with equal weights."""
        return float(np.mean(self.attachment))

    def describe(self) -> str:
        """Return a summary in a sentence."""
        away = ", ".join(f"{distance:.1e}" for distance in self.attachment)
        pieces = "1 piece" if self.components == 1 else f"{self.components} pieces"
        return (
            f"{pieces}; {self.violations:.2%} of the surface is outside of the design region, by {self.depth:.3g} at "
            f"most; the interfaces are {away} away (lengths in half the region's longest side)."
        )

    def as_dict(self) -> dict[str, object]:
        """Return the fields as plain values."""
        return {**asdict(self), "attachment": list(self.attachment), "mean_attachment": self.mean_attachment}


def measure_design(
    mesh: Mesh,
    design: Design,
    rng: np.random.Generator,
    *,
    tolerance: float = 1e-3,
    surface_points: int = 50_000,
    interface_points: int = 2000,
) -> DesignMeasurement:
    """Measure how well a part satisfies its design.

    Parameters
    ----------
    mesh : closed, in the coordinates of the region's file
    rng : for the sampled points
    tolerance : distance outside of the region from which on points are violations, in half its longest side
    surface_points : points of the mesh that are compared with the region
    interface_points : points of each interface that are compared with the mesh
    """
    part = mesh.with_vertices(design.frame.to_unit(mesh.vertices))
    outside = design.region.distance(sample_surface(part, surface_points, rng).points)
    walls = design.interfaces.sample(interface_points * len(design.interfaces), rng)
    away = nearest_on_surface(part, walls.points)[0]
    return DesignMeasurement(
        float((outside > tolerance).mean()),
        max(0.0, float(outside.max())),
        tuple(float(away[walls.pieces == piece].mean()) for piece in range(len(design.interfaces))),
        solid_pieces(part),
    )


def solid_pieces(mesh: Mesh) -> int:
    """Return the number of solids bounded by a closed, outward oriented mesh: components that are not cavities."""
    labels = face_components(mesh)
    return sum(submesh(mesh, labels == label).volume > 0 for label in range(labels.max(initial=-1) + 1))


class DesignRegion:
    """The solid inside a closed mesh, its signed distance, and points around it.

    Parameters
    ----------
    mesh : Mesh
        Closed, unit coordinates.
    margin : float
        Distance from the mesh to the faces of the problem's box.
    """

    def __init__(self, mesh: Mesh, margin: float) -> None:
        self.mesh = mesh
        self.box = Box.around(mesh.vertices, margin)

    @cached_property
    def _surface(self) -> SurfaceQuery:
        return SurfaceQuery(self.mesh)

    def inside(self, points: Float) -> Mask:
        """Return which points, of shape (N, 3), lie in the region, of shape (N,)."""
        return self._surface.inside(points)

    def distance(self, points: Float) -> Float:
        """Return the signed distance, of shape (N,), from the region's border, negative inside of it."""
        lengths = np.linalg.norm(points - self._surface.nearest(points)[0], axis=1)
        signed: Float = np.where(self.inside(points), -lengths, lengths)
        return signed

    def around(
        self, count: int, rng: np.random.Generator, *, near_share: float = 0.5, near_deviation: float = 0.03
    ) -> Float:
        """Return points of the box, of shape (count, 3), half of them uniform, half of them near the region's border.

        Parts mostly leave a region by little, where there are few uniform points.

        Parameters
        ----------
        near_share : fraction of the points that are near the border
        near_deviation : standard deviation of their distance from it along each axis, in unit coordinates
        """
        near = sample_surface(self.mesh, round(near_share * count), rng).points
        near = near + near_deviation * rng.standard_normal(near.shape)
        points = np.concatenate([self.box.sample(count - len(near), rng), near])
        return self.box.nearest(points)[0]
