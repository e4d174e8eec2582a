"""The Stanford repository's ``.conf``: the range scans of one object, each with the pose that registers it.

A line ``bmesh FILE tx ty tz qx qy qz qw`` (or ``mesh``) names a PLY file in the same folder, a translation and a
quaternion. The rotation is the inverse of the one that the quaternion commonly means: its w has the other sign. So it
is in the repository's own files: with w as written, neighbouring scans of the bunny are a hundred times their spacing
apart. Other lines (``camera``) describe a view of the object.

A range scan of that repository is a depth image: the scanner looks along -z of the scan's frame. The file does not give
its distance; it is set to a hundred times the extent of the scan, where all lines of sight are nearly parallel.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from gnrecon.geometry.arrays import Float
from gnrecon.io.contents import Contents, concatenated
from gnrecon.io.formats.ply import read_ply
from gnrecon.io.parse import parse_numbers, read_text, sibling_path
from gnrecon.runtime.errors import InputError


@dataclass(frozen=True)
class Pose:
    """A scan's file, and the rotation, of shape (3, 3), and translation, of shape (3,), that register it."""

    file: str
    rotation: Float
    translation: Float


def read_conf(path: Path) -> Contents:
    """Read all existing scans that the file names, in common coordinates, with the scanner's positions.

    Published data sets may lack some scans; these are listed in `Contents.unread`.
    """
    poses = parse_conf(read_text(path))
    existing = [pose for pose in poses if sibling_path(path.parent, pose.file, "scan").is_file()]
    absent = dict.fromkeys(pose.file for pose in poses if not (path.parent / pose.file).is_file())
    missing = tuple(f"the scan {name}, which is missing" for name in absent)
    if not existing:
        raise InputError(f"none of the {len(poses)} scans that it names exists in its folder.")
    scans = concatenated([_posed(pose, path.parent) for pose in existing])
    return replace(scans, unread=(*missing, *scans.unread))


def parse_conf(text: str) -> list[Pose]:
    """Return the scans and their poses."""
    from scipy.spatial.transform import Rotation

    poses = []
    for line in text.splitlines():
        words = line.split()
        if not words or words[0] not in ("mesh", "bmesh"):
            continue
        values = parse_numbers(words[2:])
        length = float(np.linalg.norm(values[3:])) if len(values) == 7 else 0.0
        if not (np.isfinite(values).all() and length > 0):
            raise InputError(f"the line {line.strip()[:80]!r} does not hold a file, a translation and a quaternion.")
        poses.append(Pose(words[1], Rotation.from_quat(values[3:] / length).inv().as_matrix(), values[:3]))
    if not poses:
        raise InputError("the file names no scan: lines that begin with mesh or bmesh are expected.")
    return poses


def _posed(pose: Pose, folder: Path) -> Contents:
    target = sibling_path(folder, pose.file, "scan")
    try:
        scan = read_ply(target)
    except InputError as error:
        raise InputError(f"the scan {pose.file}: {error}") from None
    if not len(scan.points):
        raise InputError(f"the scan {pose.file} holds no points.")
    origin = _scanner_position(scan.points) @ pose.rotation.T + pose.translation
    return scan.moved(pose.rotation, pose.translation, origin)


def _scanner_position(points: Float, *, distance_extents: float = 100.0) -> Float:
    """The scanner's position, of shape (3,), in the scan's frame; see the module on its distance in extents."""
    lower, upper = points.min(axis=0), points.max(axis=0)
    middle: Float = (lower + upper) / 2
    return np.array([*middle[:2], middle[2] + distance_extents * float(np.linalg.norm(upper - lower))])
