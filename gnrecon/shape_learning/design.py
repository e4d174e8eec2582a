"""A design problem from two files, in unit coordinates.

The frame is that of the design region: its box's centre is the origin and half its longest side is one. Interfaces are
usually in the same coordinates as the region. Where a file has others, as that of the paper's bracket does
(millimetres, while its region is normalised), a frame of its own says how they map: x = (file - origin) / scale.
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

MARGIN = 0.1
"""How far the problem's box reaches beyond the design region, in half its longest side."""

_STRAY, _LONGEST = 0.02, 0.1


@dataclass(frozen=True)
class Design:
    """A region to stay within and interfaces to be attached to, both in unit coordinates.

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


def read_design(region: str | Path, interfaces: str | Path, interfaces_frame: Frame | None = None) -> Design:
    """Read a design problem.

    Parameters
    ----------
    region : file of a closed mesh: the design region
    interfaces : file of a mesh of open pieces whose faces look out of the part
    interfaces_frame : leads from the interfaces' coordinates (as its file's) to those of the region's file

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
    made = DesignRegion(_cut_small(envelope.with_vertices(frame.to_unit(envelope.vertices))), MARGIN)
    _check_place(walls, made, interfaces)
    return Design(made, Interfaces(walls), frame)


def _cut_small(mesh: Mesh) -> Mesh:
    """Return the same surface with no edge longer than `_LONGEST`.

    The needles of which CAD systems make flat faces are too thin for the single precision of the search for the nearest
    point, which would be off by a thousandth.
    """
    return from_solid(to_solid(mesh, merge=False).refine_to_length(_LONGEST), mesh)


def _check_place(walls: Mesh, region: DesignRegion, path: str | Path) -> None:
    beyond = np.maximum(region.mesh.vertices.min(axis=0) - walls.vertices, walls.vertices - region.mesh.vertices.max(0))
    if beyond.max() > _STRAY:
        raise InputError(
            f"{path}: the interfaces reach {beyond.max():.3g} half-lengths of the design region beyond its box; if "
            "their coordinates are others, say which by their frame."
        )


# Interfaces: pieces of surface that a part must contain, with the normals that it must have there.
#
# They come as one mesh of separate pieces, such as the walls of bolt holes. Their faces look out of the part, as those
# of a part do: into the hole.


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
    """The interfaces of a part.

    Parameters
    ----------
    mesh : Mesh
        Unit coordinates; open, one connected piece for each interface.
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
        """Draw about `count` points, as many on each interface: a small one is held as firmly as a large one."""
        each = max(1, round(count / len(self)))
        drawn = [sample_surface(piece, each, rng) for piece in self.pieces]
        normals = [sample.normals for sample in drawn if sample.normals is not None]
        numbers = np.repeat(np.arange(len(self)), each)
        return InterfaceSample(np.concatenate([sample.points for sample in drawn]), np.concatenate(normals), numbers)


TOLERANCE = 1e-3

_SAMPLES = 50_000

_ON_EACH = 2000


# How well a part keeps to its design: what of it is outside of the region, how far interfaces are, in how many pieces.
#
# All lengths are in half the region's longest side. Interfaces of holes lie on the region's own border, and a part that
# is attached to them does, so that `violations` counts what is farther outside than a tolerance.


@dataclass(frozen=True)
class DesignFacts:
    """What a part's mesh is, against its design.

    Parameters
    ----------
    violations : share of its surface that lies farther than `TOLERANCE` outside of the region
    depth : how far its farthest sampled point lies outside; 0 when none does
    attachment : mean distance from the surface of the points of each interface
    components : solid pieces; cavities within them do not count
    """

    violations: float
    depth: float
    attachment: tuple[float, ...]
    components: int

    @property
    def mean_attachment(self) -> float:
        """Mean distance of all interfaces, each of the same weight."""
        return float(np.mean(self.attachment))

    def describe(self) -> str:
        """Say the facts in a sentence."""
        away = ", ".join(f"{distance:.1e}" for distance in self.attachment)
        pieces = "1 piece" if self.components == 1 else f"{self.components} pieces"
        return (
            f"{pieces}; {self.violations:.2%} of the surface is outside of the design region, by {self.depth:.3g} at "
            f"most; the interfaces are {away} away (lengths in half the region's longest side)."
        )

    def as_dict(self) -> dict[str, object]:
        """Return the facts as plain values."""
        return {**asdict(self), "attachment": list(self.attachment), "mean_attachment": self.mean_attachment}


def judge(mesh: Mesh, design: Design, rng: np.random.Generator) -> DesignFacts:
    """Measure a part.

    Parameters
    ----------
    mesh : closed, in the coordinates of the region's file
    rng : draws 50,000 points of its surface and 2,000 of each interface
    """
    part = mesh.with_vertices(design.frame.to_unit(mesh.vertices))
    outside = design.region.distance(sample_surface(part, _SAMPLES, rng).points)
    walls = design.interfaces.sample(_ON_EACH * len(design.interfaces), rng)
    away = nearest_on_surface(part, walls.points)[0]
    return DesignFacts(
        float((outside > TOLERANCE).mean()),
        max(0.0, float(outside.max())),
        tuple(float(away[walls.pieces == piece].mean()) for piece in range(len(design.interfaces))),
        solid_pieces(part),
    )


def solid_pieces(mesh: Mesh) -> int:
    """Return the number of solids that a closed, outward oriented mesh bounds: components that are no cavities."""
    labels = face_components(mesh)
    return sum(submesh(mesh, labels == label).volume > 0 for label in range(labels.max(initial=-1) + 1))


_NEAR_SHARE, _NEAR_SPREAD = 0.5, 0.03


# The design region: the solid inside of a closed mesh, its signed distance, and points around it.


class DesignRegion:
    """The inside of a closed mesh.

    Parameters
    ----------
    mesh : Mesh
        Closed, unit coordinates.
    margin : float
        How far the box of the problem reaches beyond the mesh on each side.
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

    def around(self, count: int, rng: np.random.Generator) -> Float:
        """Return points of the box, of shape (count, 3), half of them uniform, half of them near the region's border.

        Most of what leaves a region does so by little, where uniform points are few.
        """
        near = sample_surface(self.mesh, round(_NEAR_SHARE * count), rng).points
        near = near + _NEAR_SPREAD * rng.standard_normal(near.shape)
        points = np.concatenate([self.box.sample(count - len(near), rng), near])
        within: Float = np.clip(points, self.box.lower, self.box.upper)
        return within
