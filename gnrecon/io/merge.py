"""Reads one or several scans into one cloud in common coordinates, in bounded memory, and reports what was read.

Beyond a number of points, only the first point in each occupied voxel of a grid is kept
(`VoxelThinning`). Voxels start so small that they hardly ever hold two points. Whenever too many are occupied, their
side is doubled: eight voxels become one, whose first point is the first of all eight. The result therefore depends on
the final side only, not on how the scan was cut into chunks or when the side was doubled. The kept points are measured
ones, never averages.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gnrecon.geometry.arrays import Float, Int
from gnrecon.geometry.moments import Moments
from gnrecon.geometry.point_cloud import PointCloud, Region
from gnrecon.io.contents import Contents, concatenated, without_faces
from gnrecon.io.format_registry import CHUNK_READERS, reader_of
from gnrecon.io.formats.las import drop_unused_attributes
from gnrecon.io.formats.npy import read_npy
from gnrecon.io.formats.table import TABLE_SUFFIXES, table_chunks
from gnrecon.io.io_parameters import IOParameters
from gnrecon.io.read import opened
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

    Files are read by chunks where the format allows it, so that memory use does not grow with them. Normals and
    attributes are kept where all files have them; a mesh without normals gives those of its faces.

    Parameters
    ----------
    paths : files whose coordinates are in a common frame, directly or by the poses that they hold
    format : extension that says how all of them are read; by default each file's own
    most : points to keep, by default those of the parameters; of more, the first in each of about as many equal cubes
    region : where points are kept, in the common frame; by default everywhere
    columns : names of the columns of tables, with ``-`` for those to skip; by default, they are found out
    parameters : how many points are kept and read at a time

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


class VoxelThinning:
    """Keeps at most `most` of the points in a region that are added.

    Attributes
    ----------
    seen : number of points added
    cropped : number of points dropped because they lie outside of the region
    non_finite : number of points dropped because of a coordinate that is not finite, while thinning
    side : of the voxels, in file units; None while every point is kept
    """

    def __init__(self, most: int, region: Region | None = None) -> None:
        self.most = most
        self.region = region or Region()
        self.seen = self.cropped = self.non_finite = 0
        self.side: float | None = None
        self._pieces: list[Contents] = []
        self._first: Float | None = None

    def add(self, contents: Contents) -> None:
        """Add a chunk of points; faces are dropped once there are more points than may be kept."""
        self.seen += len(contents.points)
        if not self.region.everything:
            rows = np.flatnonzero(self.region.holds(contents.points))
            self.cropped += len(contents.points) - len(rows)
            contents = _selected(contents, rows)
        self._pieces.append(contents)
        if self.side is not None or self.seen - self.cropped > self.most:
            self._thin()

    def result(self) -> Contents:
        """Return the kept points with their normals, attributes and origins, in the order in which they came."""
        return concatenated(self._pieces)

    def _thin(self) -> None:
        kept = concatenated(self._pieces)
        finite = np.isfinite(kept.points).all(axis=1)
        self.non_finite += int((~finite).sum())
        kept = _selected(kept, np.flatnonzero(finite)) if not finite.all() else kept
        if self.side is not None and len(kept.points):
            kept = self._first_in_each_voxel(kept)
        while len(kept.points) and (self.side is None or len(kept.points) > self.most):
            if self.side is None:
                self._first, self.side = kept.points[0].copy(), 0.0
            self.side *= 2
            kept = self._first_in_each_voxel(kept)
        self._pieces = [replace(kept, faces=kept.faces[:0])]

    def _first_in_each_voxel(self, kept: Contents) -> Contents:
        keys = self._voxel_keys(kept.points)
        # np.unique returns the first row of each key, and sorting the rows keeps the order of the points.
        _, rows = np.unique(keys, return_index=True)
        return kept if len(rows) == len(keys) else _selected(kept, np.sort(rows))

    def _voxel_keys(self, points: Float) -> Int:
        """A key for each point's voxel, of shape (N,); the side grows where the grid would be too large for 64 bits."""
        assert self.side is not None
        assert self._first is not None
        # Voxels from the first point in each direction: three numbers of 21 bits fit into one key.
        reach_voxels = 1 << 20
        # The grid reaches at least this share of the largest coordinate, so that a quotient of the two never overflows.
        least_share = 2.0**-40
        # Sides are powers of two, so that dividing by them loses nothing.
        reach = float(np.maximum(np.abs(points / 2 - self._first / 2), least_share * np.abs(points)).max())
        least = 2.0 ** np.floor(np.log2(max(reach, np.finfo(np.float64).tiny / least_share)) + 2) / reach_voxels
        self.side = max(self.side, float(least))
        corner = np.floor(points / self.side - self._first / self.side)
        # Numbers from 0 to 2^21 - 1, so that keys order and compare as one integer.
        x, y, z = corner.astype(np.int64).T + reach_voxels
        keys: Int = (x << 42) | (y << 21) | z
        return keys


def _selected(contents: Contents, rows: Int) -> Contents:
    return replace(
        contents,
        points=contents.points[rows],
        normals=None if contents.normals is None else contents.normals[rows],
        faces=contents.faces[:0],
        attributes={name: values[rows] for name, values in contents.attributes.items()},
        origins=None if contents.origins is None else contents.origins[rows],
    )


def read_chunks(
    path: Path, extension: str, columns: Sequence[str] = (), *, parameters: IOParameters = IOParameters()
) -> Iterator[Contents]:
    """Yield the contents of a file by chunks; those of formats that must be read as a whole in one.

    `UsageError` is raised when columns are named of a file that is no table.
    """
    if columns and extension in (".npy", ".npz"):
        yield read_npy(path, columns)
    elif columns and extension not in TABLE_SUFFIXES:
        raise UsageError(f"--columns names the columns of tables, but {extension[1:].upper()} files are none.")
    elif columns:
        yield from table_chunks(path, parameters.chunk_points, columns)
    elif extension in CHUNK_READERS:
        yield from CHUNK_READERS[extension](path, parameters.chunk_points)
    elif read := reader_of(extension):
        yield read(path)
