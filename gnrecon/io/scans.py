"""One or several files of scans, merged in common coordinates, in bounded memory, with a word on what was read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from gnrecon.cloud import PointCloud
from gnrecon.errors import InputError
from gnrecon.io.chunks import SETTLED, chunks
from gnrecon.io.contents import Contents
from gnrecon.io.gather import Gatherer
from gnrecon.io.read import check_file, extension_for, reading
from gnrecon.io.unpack import plain_file
from gnrecon.mesh import Mesh

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
    non_finite : dropped while reading a scan that is too large to be kept, because a coordinate was not finite
    side : of the cubes of which the first point each was kept, in file units; None where every point was
    unread : what else the files hold, in words
    """

    files: tuple[str, ...]
    points: int
    kept: int
    non_finite: int = 0
    side: float | None = None
    unread: tuple[str, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Return the fields by name, for reports."""
        return asdict(self)

    def remarks(self) -> list[str]:
        """Return a sentence for what was not taken as it came."""
        sentences = [f"Not read: {', '.join(self.unread)}."] if self.unread else []
        if self.side is not None:
            sentences.append(
                f"Kept {self.kept:,} of {self.points:,} points, the first one in each cube of side {self.side:.4g}."
            )
        return sentences


def read_scans(
    paths: Sequence[str | Path], format: str | None = None, most: int = MOST_POINTS
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

    Raises
    ------
    InputError, UsageError
        As `read_cloud` does.
    """
    gatherer = Gatherer(most)
    extensions = [_gather(Path(path), format, gatherer) for path in paths]
    found = gatherer.gathered()
    for settle in {SETTLED[extension] for extension in extensions if extension in SETTLED}:
        found = settle(found)
    cloud = PointCloud(found.points, found.normals, found.attributes, found.origins)
    files = tuple(str(path) for path in paths)
    return cloud, Reading(files, gatherer.seen, len(cloud), gatherer.non_finite, gatherer.side, found.unread)


def _gather(path: Path, format: str | None, gatherer: Gatherer) -> str:
    """Add what a file holds, and return the extension by which it was read."""
    extension, before = extension_for(path, format), gatherer.seen
    with reading(path), plain_file(path, extension) as file:
        check_file(file, extension)
        for chunk in chunks(file, extension):
            gatherer.add(_with_normals(chunk))
        if gatherer.seen == before:
            raise InputError("the file holds no points.")
    return extension


def _with_normals(contents: Contents) -> Contents:
    """Give the vertices of a mesh the normals of its faces where they have none."""
    if contents.normals is None and len(contents.faces):
        contents = replace(contents, normals=Mesh(contents.points, contents.faces).vertex_normals())
    return replace(contents, faces=contents.faces[:0])
