"""Gathering a scan's chunks in bounded memory: beyond a number of points, the first one of each occupied cube stays.

Cubes begin so small that they hardly ever join two points. Whenever too many are occupied, their side is doubled: eight
cubes become one, whose first point is the first of theirs. So the result is that of the final side alone: it depends
neither on how the scan was cut into chunks nor on when the side was doubled. The points that stay are real ones.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from gnrecon.geometry.arrays import Float, Int
from gnrecon.geometry.point_cloud import Region
from gnrecon.io.contents import Contents, joined
from gnrecon.io.format_registry import reader_of
from gnrecon.io.formats.las import las_chunks, settled
from gnrecon.io.formats.ply import ply_chunks
from gnrecon.io.formats.ptx import ptx_chunks
from gnrecon.io.formats.xyz import xyz_chunks

_REACH = 1 << 20
"""Cubes from the first point in each direction: three such numbers fit into one key of 64 bits."""

_DIGITS = 2.0**-40
"""Least reach of the cubes as a share of the largest coordinate, so that a quotient of the two never overflows."""


class Gatherer:
    """Keeps at most `most` points of all that it is given in a region.

    Attributes
    ----------
    seen : how many points it was given
    cropped : how many of them lie outside of the region
    non_finite : how many of them were dropped because a coordinate was not finite, while thinning
    side : of the cubes, in file units; None while every point is kept
    """

    def __init__(self, most: int, region: Region | None = None) -> None:
        self.most = most
        self.region = region or Region()
        self.seen = self.cropped = self.non_finite = 0
        self.side: float | None = None
        self._pieces: list[Contents] = []
        self._first: Float | None = None

    def add(self, contents: Contents) -> None:
        """Take a chunk, which holds no faces once there are more points than may be kept."""
        self.seen += len(contents.points)
        if not self.region.everything:
            rows = np.flatnonzero(self.region.holds(contents.points))
            self.cropped += len(contents.points) - len(rows)
            contents = _selected(contents, rows)
        self._pieces.append(contents)
        if self.side is not None or self.seen - self.cropped > self.most:
            self._thin()

    def gathered(self) -> Contents:
        """Return what is kept, in the order in which it came.

        Cut off are only points: normals, attributes and origins of those that stay are kept.
        """
        return joined(self._pieces) if self._pieces else Contents(np.empty((0, 3)))

    def _thin(self) -> None:
        kept = joined(self._pieces)
        finite = np.isfinite(kept.points).all(axis=1)
        self.non_finite += int((~finite).sum())
        kept = _selected(kept, np.flatnonzero(finite)) if not finite.all() else kept
        if self.side is not None and len(kept.points):
            kept = self._one_each(kept)
        while len(kept.points) and (self.side is None or len(kept.points) > self.most):
            kept = self._coarser(kept)
        self._pieces = [replace(kept, faces=kept.faces[:0])]

    def _coarser(self, kept: Contents) -> Contents:
        """Double the side, or choose the first one, and drop what shares a cube then."""
        if self.side is None:
            self._first, self.side = kept.points[0].copy(), 0.0
        else:
            self.side *= 2
        return self._one_each(kept)

    def _one_each(self, kept: Contents) -> Contents:
        keys = self._keys(kept.points)
        _, rows = np.unique(keys, return_index=True)
        return kept if len(rows) == len(keys) else _selected(kept, np.sort(rows))

    def _keys(self, points: Float) -> Int:
        """The number of each point's cube, of shape (N,); doubles the side where the numbers are too large."""
        assert self.side is not None
        assert self._first is not None
        # Sides are powers of two, so that dividing by them loses nothing.
        reach = float(np.maximum(np.abs(points / 2 - self._first / 2), _DIGITS * np.abs(points)).max())
        least = 2.0 ** np.floor(np.log2(max(reach, np.finfo(np.float64).tiny / _DIGITS)) + 2) / _REACH
        self.side = max(self.side, float(least))
        corner = np.floor(points / self.side - self._first / self.side)
        x, y, z = corner.astype(np.int64).T + _REACH
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


LARGE = 1 << 24
"""Size of a file in bytes from which it is read by chunks."""

ROWS = 1 << 20
"""Points in a chunk: their arrays take some ten megabytes, and libraries work at full speed."""

CHUNKED: dict[str, Callable[[Path, int], Iterator[Contents]]] = {
    ".las": las_chunks,
    ".laz": las_chunks,
    ".ptx": ptx_chunks,
    ".ply": ply_chunks,
    **dict.fromkeys((".xyz", ".pts", ".txt", ".csv"), xyz_chunks),
}

SETTLED: dict[str, Callable[[Contents], Contents]] = {".las": settled, ".laz": settled}
"""What is done when all points of a file are known."""


# Large files by chunks, where their format allows it: LAS, LAZ, PTX, binary PLY without faces, and tables in text.
#
# To add a format, write a function from a file and a number of rows to chunks, and a line in `CHUNKED`.


def chunks(path: Path, extension: str) -> Iterator[Contents]:
    """Yield the contents of a file by chunks; small files, and formats that have to be read as a whole, in one.

    Raises
    ------
    InputError
        As the format's reader does; not before the first chunk is asked for.
    """
    if extension in CHUNKED and path.stat().st_size >= LARGE:
        yield from CHUNKED[extension](path, ROWS)
    elif read := reader_of(extension):
        yield read(path)
