"""Machine parts with narrow bores, scanned from all around by a range camera that sees little of their walls."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation
from virtual_scanner import Scanner, scan

from benchmarks.accuracy.problem import Problem
from gnrecon.geometry.mesh import Mesh

Place = tuple[float, float, float]


@dataclass(frozen=True)
class BoredPart:
    """A part in millimetres, turned off the axes.

    Parameters
    ----------
    shape : of `PARTS`
    count : points that are kept
    noise : deviation of the ranges, in bounding radii
    """

    shape: str
    count: int
    noise: float = 0.0005

    def problem(self, data: Path, seed: int) -> Problem:  # noqa: ARG002 - other cases read files
        """Return the scan of a seed, and the part."""
        part = PARTS[self.shape]()
        turned = Rotation.from_rotvec([0.12, 0.2, 0.32]).apply(part.vertices)
        truth = Mesh(turned, np.asarray(part.faces))
        radius = float(np.linalg.norm(np.ptp(turned, axis=0)) / 2)
        # The differences of single pixels are steep where ranges are noisy.
        scanner = Scanner(noise=self.noise, reach=1 if self.noise < 0.001 else 2)
        cloud = scan(truth, scanner, self.count, np.random.default_rng(seed))
        return Problem(cloud, truth, genus=round(1 - part.euler_number / 2), radius=radius)


def manifold() -> trimesh.Trimesh:
    """Return a hydraulic block with deep bores, two of which cross, and a blind one."""
    bores = [
        _cylinder(4, 100, (-20, 0, 0)),
        _cylinder(5, 120, (0, 10, 5), "x"),
        _cylinder(3.5, 100, (20, -12, 0)),
        _cylinder(4, 40, (0, -20, -10), "y"),
        _cylinder(6, 30, (25, 15, 20)),
    ]
    return _without(_box((80, 60, 50)), bores)


def clevis() -> trimesh.Trimesh:
    """Return two lugs on a foot, with bores in line and air between them."""
    lugs = [_box((12, 40, 50), (-24, 0, 25)), _box((12, 40, 50), (24, 0, 25))]
    bores = [_cylinder(7, 100, (0, 0, 32), "x"), _cylinder(3, 40, (0, 12, 0)), _cylinder(3, 40, (0, -12, 0))]
    return _without(_joined([_box((70, 40, 12)), *lugs]), bores)


def flange() -> trimesh.Trimesh:
    """Return a hub with a long bore on a disk with six holes."""
    turns = np.pi / 3 * np.arange(6)
    holes = [_cylinder(4, 40, (32 * np.cos(turn), 32 * np.sin(turn), 0)) for turn in turns]
    return _without(_joined([_cylinder(45, 10), _cylinder(18, 60, (0, 0, 30))]), [_cylinder(6, 200), *holes])


def shaft() -> trimesh.Trimesh:
    """Return a stepped shaft with blind holes in the middle of both ends and one across."""
    bores = [_cylinder(3, 24, (-60, 0, 0), "x"), _cylinder(3, 24, (60, 0, 0), "x"), _cylinder(3, 80, (-30, 0, 0))]
    return _without(_joined([_cylinder(12, 120, along="x"), _cylinder(20, 20, (10, 0, 0), "x")]), bores)


def bearing() -> trimesh.Trimesh:
    """Return a bearing block with a wide bore, a keyway, four bolt holes and a cross bore."""
    bolts = [_cylinder(4, 100, (x, y, 0)) for x in (-27, 27) for y in (-15, 15)]
    cuts = [_cylinder(18, 100, (0, 0, 8), "y"), _box((6, 60, 24), (0, 0, 28)), _cylinder(2.5, 60, (0, 0, -20), "y")]
    return _without(_box((70, 50, 60)), [*cuts, *bolts])


PARTS: dict[str, Callable[[], trimesh.Trimesh]] = {
    one.__name__: one for one in (manifold, clevis, flange, shaft, bearing)
}


def _box(sides: Place, middle: Place = (0.0, 0.0, 0.0)) -> trimesh.Trimesh:
    half = np.array(sides) / 2
    box: trimesh.Trimesh = trimesh.creation.box(bounds=[middle - half, middle + half])
    return box


def _cylinder(radius: float, length: float, middle: Place = (0.0, 0.0, 0.0), along: str = "z") -> trimesh.Trimesh:
    half = length / 2 * np.eye(3)["xyz".index(along)]
    ends = [middle - half, middle + half]
    cylinder: trimesh.Trimesh = trimesh.creation.cylinder(radius, segment=ends, sections=96)
    return cylinder


def _joined(parts: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    union: trimesh.Trimesh = trimesh.boolean.union(parts, engine="manifold")
    return union


def _without(part: trimesh.Trimesh, cuts: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    difference: trimesh.Trimesh = trimesh.boolean.difference([part, *cuts], engine="manifold")
    return difference
