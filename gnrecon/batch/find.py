"""Which scans a batch is about: files, folders, patterns, and lists of these."""

from __future__ import annotations

import glob
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path, PurePosixPath

from gnrecon.batch.job import STATE
from gnrecon.batch.naming import Found
from gnrecon.batch.record import all_records
from gnrecon.io import extension_of, readable
from gnrecon.runtime.errors import InputError


@dataclass(frozen=True)
class Search:
    """What is looked for in folders.

    Parameters
    ----------
    patterns : of file names, or of paths below the folder, such as ``"*.ply"`` or ``"left/*.e57"``; empty: all
    recursive : whether subfolders are entered
    output : folder of the batch's outputs, which are no scans, wherever it lies
    """

    patterns: tuple[str, ...] = ()
    recursive: bool = False
    output: Path | None = None


def find_scans(sources: Sequence[str], lists: Sequence[Path], search: Search) -> list[Found]:
    """Return the scans that files, folders, patterns and list files name, each once, in order.

    A list has a path, a folder or a pattern on each line, relative to its own folder; lines that begin with ``#`` are
    passed over. What a
    list names and is not there becomes a scan that fails, so that one wrong line does not stop a long batch.

    Raises
    ------
    InputError
        When a source is missing, or there is no scan at all.
    """
    found: dict[Path, Found] = {}
    for source in sources:
        for one in _expanded(source, search, must=True):
            found.setdefault(one.scan.absolute(), one)
    for listing in lists:
        for line in _lines(listing):
            for one in _expanded(line, search, must=False):
                found.setdefault(one.scan.absolute(), one)
    if not found:
        told = ", ".join([*sources, *map(str, lists)])
        wanted = f"that match {' or '.join(search.patterns)}; " if search.patterns else "; "
        raise InputError(f"There are no scans in {told} {wanted}extensions read are {', '.join(readable())}.")
    return list(found.values())


def _lines(listing: Path) -> Iterator[str]:
    try:
        lines = listing.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"The list {listing} cannot be read: {getattr(error, 'strerror', None) or error}.") from error
    for line in lines:
        text = line.strip()
        if text and not text.startswith("#"):
            yield str(listing.parent / text)


def _expanded(source: str, search: Search, must: bool) -> Iterator[Found]:
    path = Path(source)
    if path.is_dir():
        yield from _in_folder(path, search)
    elif path.exists():
        yield Found(path)
    elif glob.has_magic(source):
        known = readable()
        for match in sorted(glob.glob(source, recursive=True)):  # noqa: PTH207 - Path.glob takes no absolute patterns
            if Path(match).is_dir():
                yield from _in_folder(Path(match), search)
            elif extension_of(Path(match)) in known:
                yield Found(Path(match))
    elif must:
        raise InputError(f"There is no file or folder {source}.")
    else:
        yield Found(path)


def _in_folder(folder: Path, search: Search) -> Iterator[Found]:
    """The files of a folder that could be scans, sorted by path; neither hidden ones nor the batch's own."""
    known = readable()
    own, below = _outputs(search.output), _output_below(folder, search.output)
    for path in sorted(folder.rglob("*") if search.recursive else folder.iterdir()):
        inner = path.relative_to(folder)
        if any(part.startswith(".") for part in inner.parts) or path.resolve() in own:
            continue
        if below is not None and path.resolve().is_relative_to(below):
            continue
        if extension_of(path) in known and path.is_file() and _matches(inner, search.patterns):
            yield Found(path, PurePosixPath(inner.parent.as_posix()))


def _output_below(folder: Path, output: Path | None) -> Path | None:
    """The output folder, where it lies somewhere within a folder of scans."""
    if output is None or output.resolve() == folder.resolve():
        return None
    return output.resolve() if output.resolve().is_relative_to(folder.resolve()) else None


def _outputs(output: Path | None) -> set[Path]:
    if output is None:
        return set()
    return {(output / name).resolve() for record in all_records(output / STATE / "records") for name in record.outputs}


def _matches(inner: Path, patterns: Sequence[str]) -> bool:
    return not patterns or any(
        fnmatch(inner.name, pattern) or fnmatch(inner.as_posix(), pattern) for pattern in patterns
    )
