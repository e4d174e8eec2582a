"""Inputs of ``gnrecon learn``: the paper's shapes, other scans, and the design of a part.

The paper's two shapes are not part of gnrecon: ``--data`` names the folder that holds their files. ``--share 0.2``
learns from a fifth of the points, as in the paper's sparse experiment, and measures against all of them. Vertices
without normals get smooth normals from the faces; the paper does not define its weights.

``gnrecon learn bracket`` learns a part within a design region, attached to interfaces, from two files of its design; by
default those of the small bracket in the repository's `sample_data`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gnrecon.export import curvatures, extract, project, remove_stray, repair
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import Frame, PointCloud
from gnrecon.ingest import prepare
from gnrecon.io import read_reference
from gnrecon.runtime.errors import InputError, UsageError
from gnrecon.shape_learning import LearnedField, ShapeProblem, scanned
from gnrecon.shape_learning.design import Design, read_design

PAPER_SCANS = {"bunny": "bun_zipper.ply", "rockerarm": "rocker-arm.off"}
"""The paper's shapes by name, and their files."""


@dataclass(frozen=True)
class ScanFiles:
    """Points that a surface is learned from; see `gnrecon learn --help`.

    Raises
    ------
    UsageError
        When the share is out of range.
    """

    data: Path | None = None
    share: float | None = None

    def __post_init__(self) -> None:
        """Refuse invalid values, before any work."""
        if self.share is not None and not 0 < self.share <= 1:
            raise UsageError(f"The share of the points is {self.share:g}, but must be above 0 and at most 1.")

    def path(self, name: str) -> Path:
        """Return the file of one of the paper's shapes, or of another scan.

        Raises
        ------
        InputError
            When there is none.
        """
        if name not in PAPER_SCANS:
            return Path(name)
        if self.data is None:
            raise InputError(
                f"The {name} is not part of gnrecon: --data names the folder that holds {PAPER_SCANS[name]}."
            )
        places = [self.data / folder / PAPER_SCANS[name] for folder in (".", "paper")]
        found = next((place for place in places if place.is_file()), None)
        if found is None:
            raise InputError(f"The folder {self.data} does not hold {PAPER_SCANS[name]}.")
        return found

    def problem(self, name: str, seed: int, *, fewest_points: int = 20) -> tuple[ShapeProblem, Frame]:
        """Return the problem of a shape, in unit coordinates, and the frame of its file's coordinates.

        At least `fewest_points` are learned from, however small the share.

        Raises
        ------
        InputError
            When the file is missing or cannot be read.
        """
        found = read_reference(self.path(name))
        cloud = PointCloud(found.vertices, found.smooth_normals()) if isinstance(found, Mesh) else found
        every, _ = prepare(cloud, outliers="off", clusters="off", seed=seed)
        if self.share is None:
            return scanned(every, name=name, seed=seed), every.frame
        count = max(fewest_points, round(self.share * len(every)))
        rows = np.sort(np.random.default_rng(seed).permutation(len(every))[:count])
        kept = every.select(rows)
        return scanned(kept, every, name, seed), every.frame


def is_scan(name: str) -> bool:
    """Return whether a problem is named by one of the paper's shapes or by a file."""
    return name in PAPER_SCANS or Path(name).suffix != ""


def placed(mesh: Mesh, frame: Frame) -> Mesh:
    """Return a mesh in unit coordinates in those of the frame's file."""
    return mesh.with_vertices(frame.to_world(mesh.vertices))


@dataclass(frozen=True)
class DesignFiles:
    """Files of a part's design; see `gnrecon learn --help`.

    Raises
    ------
    UsageError
        When only one of the two files is named, or the frame or the clip is invalid.
    """

    region: Path | None = None
    interfaces: Path | None = None
    interfaces_frame: str | None = None
    clip: float | None = None

    def __post_init__(self) -> None:
        """Refuse invalid values, before any work."""
        if (self.region is None) != (self.interfaces is None):
            raise UsageError("A design needs both --region and --interfaces.")
        if self.region is None and self.interfaces_frame is not None:
            raise UsageError("--interfaces-frame needs --interfaces.")
        if self.clip is not None and not self.clip > 0:
            raise UsageError(f"The strain is clipped at {self.clip:g}, but the limit must be positive.")
        self.frame()

    def named(self) -> list[Path]:
        """Return the files that were named."""
        return [path for path in (self.region, self.interfaces) if path is not None]

    def frame(self) -> Frame | None:
        """Return the frame of the interfaces' coordinates, if they have their own."""
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
            As `read_design` does, or when the sample is missing.
        """
        region, interfaces = self.region, self.interfaces
        if region is None or interfaces is None:
            sample = Path(__file__).resolve().parents[2] / "sample_data"
            region, interfaces = sample / "design_region.stl", sample / "design_interfaces.stl"
            if not region.exists():
                raise InputError("The sample's design is missing; name a design by --region and --interfaces.")
        return read_design(region, interfaces, self.frame())


def part_mesh(
    field: LearnedField,
    design: Design,
    resolution: int,
    curvature: bool,
    rng: np.random.Generator,
    *,
    interface_samples: int = 5000,
) -> tuple[Mesh, list[str]]:
    """Return a part's closed mesh, in the coordinates of the region's file, and sentences about repairs.

    Pieces that no interface is nearest to carry no load and are dropped.

    Parameters
    ----------
    field : learned, in the design's unit coordinates
    resolution : cells along the longest side of its box
    curvature : whether vertices carry the field's mean and Gauss curvature, per unit of the file
    rng : draws points on the interfaces
    interface_samples : number of these points

    Raises
    ------
    MeshError
        When there is no zero level in the box, or no sound mesh can be made of it.
    """
    mesh = project(extract(field, resolution=resolution), field)
    mesh, dropped = remove_stray(mesh, design.interfaces.sample(interface_samples, rng).points)
    mesh, mended = repair(mesh)
    if curvature:
        mean, gauss = curvatures(field.gradient(mesh.vertices), field.hessian(mesh.vertices))
        scale = design.frame.scale
        mesh = mesh.with_attributes({"mean_curvature": mean / scale, "gauss_curvature": gauss / scale**2})
    return mesh.with_vertices(design.frame.to_world(mesh.vertices)), [*dropped, *mended]
