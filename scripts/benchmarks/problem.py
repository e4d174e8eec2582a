"""What is set to every method alike: a scan, and the surface that its mesh should be."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import PointCloud


@dataclass(frozen=True)
class Problem:
    """A scan and its truth, in one frame.

    Parameters
    ----------
    scan : PointCloud
    truth : Mesh or PointCloud
        What meshes are measured against; points where no surface is known.
    genus : int, optional
        The truth's, where it is known.
    radius : float, optional
        Distances are told in 1e-3 of it; None where they are told in the scan's own unit.
    outliers : bool
        Whether the scan is known to hold points far off the surface, so that every method may remove them.
    samples_apart : int
        Samples on each surface for distances from sample to sample, as they are published for the SRB; 0 for none.
    up, view : str, (azimuth, elevation) in degrees
        From where pictures are drawn.
    """

    scan: PointCloud
    truth: Mesh | PointCloud
    genus: int | None = None
    radius: float | None = 1.0
    outliers: bool = False
    samples_apart: int = 0
    up: str = "z"
    view: tuple[float, float] = (35.0, 25.0)

    @property
    def factor(self) -> float:
        """What distances are multiplied by to be told."""
        return 1.0 if self.radius is None else 1e3 / self.radius

    @property
    def unit(self) -> str:
        """What the told distances are in."""
        return "the scan's unit" if self.radius is None else "1e-3 of the radius"


class Case(Protocol):
    """A way to a problem; one line of a table of cases."""

    def problem(self, data: Path, seed: int) -> Problem:
        """Return the problem of a seed, reading what it needs from the folder `data`.

        Raises
        ------
        InputError
            When a file is missing or cannot be read.
        """
        ...
