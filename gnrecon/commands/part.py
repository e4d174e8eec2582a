"""``gnrecon learn bracket``: a part within a design region, attached to interfaces, from two files of its design.

Without files the small bracket of the repository's `sample_data` is learned. The part's mesh is closed, in the
coordinates of the region's file; pieces of it that no interface is nearest to hold nothing, and are dropped.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gnrecon.design import Design, read_design
from gnrecon.export import curvatures, project, remove_stray, repair
from gnrecon.export import marching_cubes as extract
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import Frame
from gnrecon.runtime.errors import InputError, UsageError
from gnrecon.shapes import LearnedField

NAME = "bracket"
SAMPLE = Path(__file__).resolve().parents[2] / "sample_data"
_HOLDING = 5000


@dataclass(frozen=True)
class DesignFiles:
    """What describes a part's design; see `gnrecon learn --help`.

    Raises
    ------
    UsageError
        When only one of the two files is named, or the frame or the clip is none.
    """

    region: Path | None = None
    interfaces: Path | None = None
    interfaces_frame: str | None = None
    clip: float | None = None

    def __post_init__(self) -> None:
        """Refuse what makes no sense, before any work."""
        if (self.region is None) != (self.interfaces is None):
            raise UsageError("A design is both --region and --interfaces; only one of them is named.")
        if self.region is None and self.interfaces_frame is not None:
            raise UsageError("--interfaces-frame is for --interfaces, which is not named.")
        if self.clip is not None and not self.clip > 0:
            raise UsageError(f"The strain is clipped at {self.clip:g}, but must be at something positive.")
        self.frame()

    def named(self) -> list[Path]:
        """Return the files that were named."""
        return [path for path in (self.region, self.interfaces) if path is not None]

    def frame(self) -> Frame | None:
        """Return the frame of the interfaces' coordinates, if they have one of their own."""
        if self.interfaces_frame is None:
            return None
        try:
            x, y, z, scale = (float(word) for word in self.interfaces_frame.split(","))
        except ValueError:
            x = y = z = scale = np.nan
        if not (np.isfinite([x, y, z, scale]).all() and scale > 0):
            raise UsageError(f"The interfaces' frame is {self.interfaces_frame!r}, but must be X,Y,Z,SCALE.")
        return Frame(np.array([x, y, z]), scale)

    def read(self) -> Design:
        """Return the design, by default that of `sample_data`.

        Raises
        ------
        InputError
            As `read_design` does, or when the sample is not there.
        """
        region, interfaces = self.region, self.interfaces
        if region is None or interfaces is None:
            region, interfaces = SAMPLE / "design_region.stl", SAMPLE / "design_interfaces.stl"
            if not region.exists():
                raise InputError("The sample's design is not there; name one by --region and --interfaces.")
        return read_design(region, interfaces, self.frame())


def part_mesh(
    field: LearnedField, design: Design, resolution: int, curvature: bool, rng: np.random.Generator
) -> tuple[Mesh, list[str]]:
    """Return a part's closed mesh, in the coordinates of the region's file, and sentences about what was mended.

    Parameters
    ----------
    field : learned, in the design's unit coordinates
    resolution : cells along the longest side of its box
    curvature : whether vertices carry the field's mean and Gauss curvature, per unit of the file
    rng : draws points of the interfaces, which tell what holds something

    Raises
    ------
    MeshError
        When there is no zero level in the box, or no sound mesh can be made of it.
    """
    mesh = project(extract(field, resolution=resolution), field)
    mesh, dropped = remove_stray(mesh, design.interfaces.sample(_HOLDING, rng).points)
    mesh, mended = repair(mesh)
    if curvature:
        mean, gauss = curvatures(field.gradient(mesh.vertices), field.hessian(mesh.vertices))
        scale = design.frame.scale
        mesh = mesh.with_attributes({"mean_curvature": mean / scale, "gauss_curvature": gauss / scale**2})
    return mesh.with_vertices(design.frame.to_world(mesh.vertices)), [*dropped, *mended]
