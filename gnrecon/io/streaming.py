"""Reads large files by chunks, and thins the points in bounded memory by a voxel grid (`VoxelThinning`).

Beyond a number of points, only the first point in each occupied voxel is kept. Voxels start so small that they hardly
ever hold two points. Whenever too many are occupied, their side is doubled: eight voxels become one, whose first point
is the first of all eight. The result therefore depends on the final side only, not on how the scan was cut into chunks
or when the side was doubled. The kept points are measured ones, never averages.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from gnrecon.geometry.arrays import Float, Int
from gnrecon.geometry.point_cloud import Region
from gnrecon.io.contents import Contents, concatenated
from gnrecon.io.format_registry import CHUNK_READERS, reader_of
from gnrecon.io.formats.npy import read_npy
from gnrecon.io.formats.table import TABLE_SUFFIXES, table_chunks
from gnrecon.io.io_parameters import IOParameters
from gnrecon.runtime.errors import UsageError


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
    """Yield the contents of a file by chunks; small files, and formats that must be read as a whole, in one.

    `UsageError` is raised when columns are named of a file that is no table.
    """
    by_chunks = CHUNK_READERS.get(extension)
    if columns and extension in (".npy", ".npz"):
        yield read_npy(path, columns)
    elif columns and extension not in TABLE_SUFFIXES:
        raise UsageError(f"--columns names the columns of tables, but {extension[1:].upper()} files are none.")
    elif columns:
        yield from table_chunks(path, parameters.chunk_points, columns)
    elif by_chunks is not None and path.stat().st_size >= parameters.chunked_file_bytes:
        yield from by_chunks(path, parameters.chunk_points)
    elif read := reader_of(extension):
        yield read(path)
