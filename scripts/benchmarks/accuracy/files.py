"""Scans that are files: those of the Surface Reconstruction Benchmark, and sparse ones without normals."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from benchmarks.problem import Problem
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import Frame, PointCloud
from gnrecon.io import read_cloud, read_mesh
from gnrecon.runtime.errors import InputError

SAMPLES_APART = 1_000_000
"""Samples on each surface in the protocol of DiGS (Ben-Shabat et al. 2022)."""


@dataclass(frozen=True)
class RangeScan:
    """A simulated range scan, compared in its own unit; by the distances of the DiGS protocol as well.

    Parameters
    ----------
    file : within the data folder
    truth : file of the true surface; where there is none, meshes are measured against the scan itself
    genus : of the true surface
    normals : whether those of the file are given to the methods
    up, view : from where it is drawn
    """

    file: str
    truth: str | None = None
    genus: int | None = None
    normals: bool = True
    up: str = "y"
    view: tuple[float, float] = (25.0, 15.0)

    def problem(self, data: Path, seed: int) -> Problem:  # noqa: ARG002 - the scan is as it is
        """Return the scan, and its truth or itself.

        Raises
        ------
        InputError
            When a file is missing or cannot be read.
        """
        scan = read_cloud(_existing(data / self.file))
        truth: Mesh | PointCloud = scan if self.truth is None else read_mesh(_existing(data / self.truth))
        given = scan if self.normals else scan.with_normals(None)
        apart = SAMPLES_APART if self.truth else 0
        return Problem(given, truth, self.genus, None, samples_apart=apart, up=self.up, view=self.view)


@dataclass(frozen=True)
class BareScan:
    """Points without normals, and the file of the true surface, brought into the truth's unit frame."""

    file: str
    truth: str
    genus: int
    up: str = "y"
    view: tuple[float, float] = (25.0, 15.0)

    def problem(self, data: Path, seed: int) -> Problem:  # noqa: ARG002 - the scan is as it is
        """Return the scan and its truth.

        Raises
        ------
        InputError
            When a file is missing or cannot be read.
        """
        truth = read_mesh(_existing(data / self.truth))
        frame = Frame.of(truth.vertices)
        scan = PointCloud(frame.to_unit(read_cloud(_existing(data / self.file)).points))
        return Problem(scan, Mesh(frame.to_unit(truth.vertices), truth.faces), self.genus, up=self.up, view=self.view)


def _existing(path: Path) -> Path:
    if not path.is_file():
        raise InputError(f"There is no file {path}; name the folder that holds the benchmark's scans with --data.")
    return path
