"""``gnrecon learn bunny``: the paper's shapes, or a scan of one's own, with the paper's network and loss.

The paper's two shapes are not part of gnrecon: ``--data`` names the folder that holds their files. ``--share 0.2``
learns from a fifth of the points, as the paper's sparse experiment does, and measures against all of them. A mesh's
vertices without normals take smooth ones of its faces; the paper does not say which weights its own have.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import Frame, PointCloud
from gnrecon.ingest import prepare
from gnrecon.io import read_reference
from gnrecon.runtime.errors import InputError, UsageError
from gnrecon.shapes import ShapeProblem, scanned

FILES = {"bunny": "bun_zipper.ply", "rockerarm": "rocker-arm.off"}
"""The paper's shapes, by the names of their files."""

LEAST_POINTS = 20
"""That are kept, however small the share."""

FOLDERS = (".", "paper")
"""Where in the folder of data they may be."""


@dataclass(frozen=True)
class ScanFiles:
    """Which points a surface is learned from; see `gnrecon learn --help`.

    Raises
    ------
    UsageError
        When the share is none.
    """

    data: Path | None = None
    share: float | None = None

    def __post_init__(self) -> None:
        """Refuse what makes no sense, before any work."""
        if self.share is not None and not 0 < self.share <= 1:
            raise UsageError(f"The share of the points is {self.share:g}, but must be above 0 and at most 1.")

    def path(self, name: str) -> Path:
        """Return the file of one of the paper's shapes, or of a scan that is named by its file.

        Raises
        ------
        InputError
            When there is none.
        """
        if name not in FILES:
            return Path(name)
        if self.data is None:
            raise InputError(f"The {name} is not part of gnrecon: --data names the folder that holds {FILES[name]}.")
        places = [self.data / folder / FILES[name] for folder in FOLDERS]
        found = next((place for place in places if place.is_file()), None)
        if found is None:
            raise InputError(f"The folder {self.data} does not hold {FILES[name]}, so that there is no {name}.")
        return found

    def problem(self, name: str, seed: int) -> tuple[ShapeProblem, Frame]:
        """Return the problem of a shape, in unit coordinates, and the frame that leads back to its file's.

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
        count = max(LEAST_POINTS, round(self.share * len(every)))
        rows = np.sort(np.random.default_rng(seed).permutation(len(every))[:count])
        kept = replace(every, points=every.points[rows], normals=every.normals[rows])
        return scanned(kept, every, name, seed), every.frame


def is_scan(name: str) -> bool:
    """Return whether a problem is named by one of the paper's shapes or by a file."""
    return name in FILES or Path(name).suffix != ""


def placed(mesh: Mesh, frame: Frame) -> Mesh:
    """Return a mesh of unit coordinates in those of the frame's file."""
    return mesh.with_vertices(frame.to_world(mesh.vertices))
