"""One or several files of scans, merged in common coordinates, in bounded memory, with a word on what was read."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from gnrecon.geometry.arrays import Float
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import PointCloud, Region
from gnrecon.io.contents import Contents
from gnrecon.io.formats.stanford_conf import parse_conf
from gnrecon.io.parse import beside, read_text
from gnrecon.io.read import check_file, extension_for, extension_of, plain_file, reading
from gnrecon.io.streaming import SETTLED, Gatherer, chunks
from gnrecon.runtime.errors import InputError, UsageError

_log = logging.getLogger(__name__)

MOST_POINTS = 2_000_000
"""Points that are kept of a scan by default: a surface is described well by far fewer."""


@dataclass(frozen=True)
class Reading:
    """What was read.

    Parameters
    ----------
    files : their names, as they were given
    points : points in all files together
    kept : how many of them were kept
    cropped : dropped, because they lie outside of the wanted region
    non_finite : dropped while reading a scan that is too large to be kept, because a coordinate was not finite
    side : of the cubes of which the first point each was kept, in file units; None where every point was
    unread : what else the files hold, in words
    same : pairs of files that hold the same scan, in the same place or not
    """

    files: tuple[str, ...]
    points: int
    kept: int
    cropped: int = 0
    non_finite: int = 0
    side: float | None = None
    unread: tuple[str, ...] = ()
    same: tuple[tuple[str, str], ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Return the fields by name, for reports."""
        return asdict(self)

    def remarks(self) -> list[str]:
        """Return a sentence for what was not taken as it came."""
        sentences = [f"Not read: {', '.join(self.unread)}."] if self.unread else []
        for first, second in self.same:
            sentences.append(f"{second} seems to be the same scan as {first}, which adds nothing or, if moved, layers.")
        if self.cropped:
            sentences.append(f"Dropped {self.cropped:,} of {self.points:,} points outside of the wanted region.")
        if self.side is not None:
            wanted = self.points - self.cropped
            sentences.append(
                f"Kept {self.kept:,} of {wanted:,} points, the first one in each cube of side {self.side:.4g}."
            )
        return sentences


def read_scans(
    paths: Sequence[str | Path],
    format: str | None = None,
    most: int = MOST_POINTS,
    region: Region | None = None,
) -> tuple[PointCloud, Reading]:
    """Read the points of all files into one cloud, in the files' own units, and say what was read.

    Where there are more than `most` points, the first one in each of as many equal cubes is kept; large files of
    formats that allow it are read by chunks, so that memory does not grow with them. Normals and attributes are kept
    where all files have them; a mesh without normals gives those of its faces.

    Parameters
    ----------
    paths : files whose coordinates have a common frame, by themselves or by the poses that they hold
    format : extension that says how all of them are read; by default each file's own
    most : points to keep, at least 1
    region : where points are wanted, in the common frame; by default everywhere

    Raises
    ------
    InputError, UsageError
        As `read_cloud` does, and when no point lies in the region.
    """
    gatherer = Gatherer(most, region)
    moments = [Moments() for _ in paths]
    extensions = [_gather(Path(path), format, gatherer, sums) for path, sums in zip(paths, moments, strict=True)]
    found = gatherer.gathered()
    for settle in {SETTLED[extension] for extension in extensions if extension in SETTLED}:
        found = settle(found)
    cloud = PointCloud(found.points, found.normals, found.attributes, found.origins)
    require_points(cloud, gatherer.seen)
    files = tuple(str(path) for path in paths)
    counts = (gatherer.seen, len(cloud), gatherer.cropped, gatherer.non_finite)
    return cloud, Reading(files, *counts, gatherer.side, found.unread, same_scans(files, moments))


def cropped(cloud: PointCloud, region: Region) -> tuple[PointCloud, Reading]:
    """Return the points of a cloud in a region, and what was dropped.

    Raises
    ------
    UsageError
        When there are none.
    """
    inside = cloud if region.everything else cloud.select(region.holds(cloud.points))
    require_points(inside, len(cloud))
    return inside, Reading((), len(cloud), len(inside), len(cloud) - len(inside))


def require_points(cloud: PointCloud, before: int) -> None:
    """Refuse a region that holds none of `before` points.

    Raises
    ------
    UsageError
        With the sentence that says so.
    """
    if before and not len(cloud):
        raise UsageError(
            f"None of the {before:,} points lies in the region that is wanted; gnrecon info tells the scan's box."
        )


def _gather(path: Path, format: str | None, gatherer: Gatherer, moments: Moments) -> str:
    """Add what a file holds, and return the extension by which it was read."""
    extension, before = extension_for(path, format), gatherer.seen
    with reading(path), plain_file(path, extension) as file:
        check_file(file, extension)
        for chunk in chunks(file, extension):
            moments.add(chunk.points)
            gatherer.add(_with_normals(chunk))
        if gatherer.seen == before:
            raise InputError("the file holds no points.")
    _log.info("Read %d points of %s as %s.", gatherer.seen - before, path, extension)
    return extension


def _with_normals(contents: Contents) -> Contents:
    """Give the vertices of a mesh the normals of its faces where they have none."""
    if contents.normals is None and len(contents.faces):
        contents = replace(contents, normals=Mesh(contents.points, contents.faces).vertex_normals())
    return replace(contents, faces=contents.faces[:0])


_LEAST = 25
"""Points below which moments may agree by chance."""

_AGREEMENT = 1e-5
"""Of the moments, as a share of the largest: what float32 leaves of coordinates."""


# Telling that two files hold the same scan, wherever each of them puts it.
#
# The number of points and the principal moments of inertia do not change when a scan is moved. They are summed while
# the chunks pass, about a scan's first point, so that far-off coordinates lose no digits.


class Moments:
    """Sums over the points of one file."""

    def __init__(self) -> None:
        self.count = 0
        self._first: Float | None = None
        self._sum, self._products = np.zeros(3), np.zeros((3, 3))

    def add(self, points: Float) -> None:
        """Take a chunk of points, of shape (N, 3); those that are not finite do not count."""
        finite = np.isfinite(points).all(axis=1)
        points = points if finite.all() else points[finite]
        if not len(points):
            return
        if self._first is None:
            self._first = points[0].copy()
        with np.errstate(over="ignore", invalid="ignore"):
            offsets = points - self._first
            self.count += len(points)
            self._sum += offsets.sum(axis=0)
            self._products += offsets.T @ offsets

    def principal(self) -> Float:
        """Return the variances along the principal axes, of shape (3,); NaN where they are not finite."""
        with np.errstate(over="ignore", invalid="ignore"):
            mean = self._sum / max(self.count, 1)
            covariance: Float = self._products / max(self.count, 1) - np.outer(mean, mean)
        if not np.isfinite(covariance).all():
            return np.full(3, np.nan)
        return np.asarray(np.linalg.eigvalsh(covariance), np.float64)

    def same_as(self, other: Moments) -> bool:
        """Whether both may be the same scan, moved or not."""
        if self.count != other.count or self.count < _LEAST:
            return False
        mine, theirs = self.principal(), other.principal()
        return bool((np.abs(mine - theirs) <= _AGREEMENT * mine.max()).all())


def same_scans(files: Sequence[str], moments: Sequence[Moments]) -> tuple[tuple[str, str], ...]:
    """Return pairs of files that hold the same scan, each file at most once as the second one."""
    found = []
    for place, name in enumerate(files):
        earlier = (one for one in range(place) if moments[one].same_as(moments[place]))
        if (first := next(earlier, None)) is not None:
            found.append((files[first], name))
    return tuple(found)


# Which files a scan consists of: its own, and those that its own names.


def input_files(path: Path, format: str | None = None) -> list[Path]:
    """Return a scan's file and all files that it names and that exist, each once.

    A file that cannot be parsed names none: its reader reports what is wrong with it.

    Parameters
    ----------
    path : the scan's file
    format : extension that says how the file is read, such as ``"conf"``; by default its own
    """
    extension = extension_of(path) if format is None else f".{format.lower().removeprefix('.')}"
    try:
        names = _NAMES.get(extension, lambda _: [])(path)
        named = [beside(path.parent, name, "file") for name in names]
    except (InputError, OSError, ValueError, KeyError, TypeError, AttributeError):
        named = []
    return list(dict.fromkeys([path, *(file for file in named if file.is_file())]))


def all_input_files(paths: Iterable[Path], format: str | None = None) -> list[Path]:
    """Return all files that scans are read from, see `input_files`: none of them may be written."""
    return [file for path in paths for file in input_files(path, format)]


def _of_conf(path: Path) -> list[str]:
    return [pose.file for pose in parse_conf(read_text(path))]


def _of_gltf(path: Path) -> list[str]:
    uris = [str(one["uri"]) for one in json.loads(path.read_bytes()).get("buffers", [])]
    return [unquote(uri) for uri in uris if not uri.startswith("data:")]


_NAMES = {".conf": _of_conf, ".gltf": _of_gltf}
