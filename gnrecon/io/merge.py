"""Reads one or several scans into one cloud in common coordinates, in bounded memory, and reports what was read."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from gnrecon.geometry.moments import Moments
from gnrecon.geometry.point_cloud import PointCloud, Region
from gnrecon.io.contents import without_faces
from gnrecon.io.formats.las import drop_unused_attributes
from gnrecon.io.io_parameters import IOParameters
from gnrecon.io.read import opened
from gnrecon.io.streaming import VoxelThinning, read_chunks
from gnrecon.runtime.errors import InputError, UsageError

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Reading:
    """Report on what was read.

    Parameters
    ----------
    files : names of the files, as they were given
    points : points in all files together
    kept : number of points kept
    cropped : number of points dropped because they lie outside of the region
    non_finite : number of points dropped because of a coordinate that is not finite, while thinning a large scan
    side : of the cubes in each of which the first point was kept, in file units; None where all points were kept
    unread : descriptions of what else the files hold
    same : pairs of files that hold the same scan, possibly moved
    notes : sentences on how the files were read, where they can be read in several ways
    """

    files: tuple[str, ...]
    points: int
    kept: int
    cropped: int = 0
    non_finite: int = 0
    side: float | None = None
    unread: tuple[str, ...] = ()
    same: tuple[tuple[str, str], ...] = ()
    notes: tuple[str, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Return the fields by name, for reports."""
        return asdict(self)

    def remarks(self) -> list[str]:
        """Return a sentence for everything that was dropped or looks wrong."""
        sentences = [*self.notes, *([f"Not read: {', '.join(self.unread)}."] if self.unread else [])]
        what = "it adds nothing or, if moved, a second layer"
        sentences += [f"{second} seems to be the same scan as {first}; {what}." for first, second in self.same]
        if self.cropped:
            sentences.append(f"Dropped {self.cropped:,} of {self.points:,} points outside of the region.")
        if self.side is not None:
            kept = f"Kept {self.kept:,} of {self.points - self.cropped:,} points"
            sentences.append(f"{kept}, the first one in each cube of side {self.side:.4g}.")
        return sentences


def read_scans(
    paths: Sequence[str | Path],
    format: str | None = None,
    most: int | None = None,
    region: Region | None = None,
    *,
    columns: Sequence[str] = (),
    parameters: IOParameters = IOParameters(),
) -> tuple[PointCloud, Reading]:
    """Read the points of all files into one cloud, in the files' own units, and report what was read.

    If there are more than `most` points, only the first one in each of about as many equal cubes is kept. Large files
    are read by chunks where the format allows it, so that memory use does not grow with them. Normals and attributes
    are kept where all files have them; a mesh without normals gives those of its faces.

    Parameters
    ----------
    paths : files whose coordinates are in a common frame, directly or by the poses that they hold
    format : extension that says how all of them are read; by default each file's own
    most : points to keep, at least 1; by default ``parameters.most_points``
    region : where points are kept, in the common frame; by default everywhere
    columns : names of the columns of tables, with ``-`` for those to skip; by default, they are found out
    parameters : when files are read by chunks, and how large these are

    Raises
    ------
    InputError, UsageError
        As `read_cloud` does, and when no point lies in the region.
    """
    thinning = VoxelThinning(parameters.most_points if most is None else most, region)
    moments, extensions = [Moments() for _ in paths], set[str]()
    for path, sums in zip(map(Path, paths), moments, strict=True):
        before = thinning.seen
        with opened(path, format) as (file, extension):
            for chunk in read_chunks(file, extension, columns, parameters=parameters):
                sums.add(chunk.points)
                thinning.add(without_faces(chunk))
            if thinning.seen == before:
                raise InputError("the file holds no points.")
        extensions.add(extension)
        _log.info("Read %d points of %s as %s.", thinning.seen - before, path, extension)
    found = thinning.result()
    if {".las", ".laz"} & extensions:
        # A chunk cannot say which attributes were never filled in; only all of its points can.
        found = drop_unused_attributes(found)
    cloud = found.cloud()
    _require_points(cloud, thinning.seen)
    files = tuple(str(path) for path in paths)
    counts = (thinning.seen, len(cloud), thinning.cropped, thinning.non_finite)
    return cloud, Reading(files, *counts, thinning.side, found.unread, _same_scans(files, moments), found.remarks)


def cropped(cloud: PointCloud, region: Region) -> tuple[PointCloud, Reading]:
    """Return the points of a cloud in a region, and what was dropped; `UsageError` is raised where there are none."""
    inside = cloud if region.everything else cloud.select(region.holds(cloud.points))
    _require_points(inside, len(cloud))
    return inside, Reading((), len(cloud), len(inside), len(cloud) - len(inside))


def _require_points(cloud: PointCloud, before: int) -> None:
    """Refuse a region that holds none of `before` points."""
    if before and not len(cloud):
        raise UsageError(f"None of the {before:,} points lies in the region; gnrecon info prints the scan's box.")


def _same_scans(files: Sequence[str], moments: Sequence[Moments]) -> tuple[tuple[str, str], ...]:
    """Return pairs of files that hold the same scan, each file at most once as the second one."""
    firsts = [next(k for k in range(i + 1) if k == i or moments[k].same_as(moments[i])) for i in range(len(files))]
    return tuple((files[first], files[i]) for i, first in enumerate(firsts) if first < i)
