"""One or several files of scans, merged in common coordinates, in bounded memory, with a word on what was read."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import PointCloud, Region
from gnrecon.io.chunks import SETTLED, chunks
from gnrecon.io.contents import Contents
from gnrecon.io.gather import Gatherer
from gnrecon.io.read import check_file, extension_for, reading
from gnrecon.io.same_scan import Moments, same_scans
from gnrecon.io.unpack import plain_file
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
