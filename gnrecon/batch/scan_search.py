"""Finds the scans of a batch, names their outputs by a template, and pairs them with references by file name."""

from __future__ import annotations

import glob
import string
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatch
from pathlib import Path, PurePosixPath

from gnrecon.batch.job import all_records
from gnrecon.batch.request import Request
from gnrecon.io import extension_of, readable
from gnrecon.runtime.errors import InputError, UsageError


@dataclass(frozen=True)
class ScanSearch:
    """What to look for in folders.

    Parameters
    ----------
    patterns : of file names, or of paths below the folder, such as ``"*.ply"`` or ``"left/*.e57"``; empty: all
    recursive : whether subfolders are searched
    output : folder of the batch's outputs, which are not taken as scans, wherever it lies
    """

    patterns: tuple[str, ...] = ()
    recursive: bool = False
    output: Path | None = None


def find_scans(sources: Sequence[str], lists: Sequence[Path], search: ScanSearch) -> list[FoundScan]:
    """Return the scans that files, folders, patterns and list files name, each once, in order.

    A list has a path, a folder or a pattern on each line, relative to its own folder; lines that begin with ``#`` are
    skipped. A missing file in a list becomes a scan that fails, so that one wrong line does not stop a long batch.

    Raises
    ------
    InputError
        When a source is missing, or there is no scan at all.
    """
    found: dict[Path, FoundScan] = {}
    for source in sources:
        for scan in _expanded(source, search, required=True):
            found.setdefault(scan.scan.absolute(), scan)
    for listing in lists:
        for line in _lines(listing):
            for scan in _expanded(line, search, required=False):
                found.setdefault(scan.scan.absolute(), scan)
    if not found:
        searched = ", ".join([*sources, *map(str, lists)])
        matching = f" that match {' or '.join(search.patterns)}" if search.patterns else ""
        raise InputError(f"There are no scans in {searched}{matching}; extensions read are {', '.join(readable())}.")
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


def _expanded(source: str, search: ScanSearch, required: bool) -> Iterator[FoundScan]:
    path = Path(source)
    if path.is_dir():
        yield from _in_folder(path, search)
    elif path.exists():
        yield FoundScan(path)
    elif glob.has_magic(source):
        known = readable()
        for match in sorted(glob.glob(source, recursive=True)):  # noqa: PTH207 - Path.glob takes no absolute patterns
            if Path(match).is_dir():
                yield from _in_folder(Path(match), search)
            elif extension_of(Path(match)) in known:
                yield FoundScan(Path(match))
    elif required:
        raise InputError(f"There is no file or folder {source}.")
    else:
        yield FoundScan(path)


def _in_folder(folder: Path, search: ScanSearch) -> Iterator[FoundScan]:
    """The files of a folder that may be scans, sorted by path, without hidden files and outputs of the batch."""
    known = readable()
    own, below = _outputs(search.output), _output_below(folder, search.output)
    for path in sorted(folder.rglob("*") if search.recursive else folder.iterdir()):
        inner = path.relative_to(folder)
        if any(part.startswith(".") for part in inner.parts) or path.resolve() in own:
            continue
        if below is not None and path.resolve().is_relative_to(below):
            continue
        if extension_of(path) in known and path.is_file() and _matches(inner, search.patterns):
            yield FoundScan(path, PurePosixPath(inner.parent.as_posix()))


def _output_below(folder: Path, output: Path | None) -> Path | None:
    """The output folder, where it lies within a folder of scans."""
    if output is None or output.resolve() == folder.resolve():
        return None
    return output.resolve() if output.resolve().is_relative_to(folder.resolve()) else None


def _outputs(output: Path | None) -> set[Path]:
    if output is None:
        return set()
    return {(output / name).resolve() for record in all_records(output) for name in record.outputs}


def _matches(inner: Path, patterns: Sequence[str]) -> bool:
    return not patterns or any(
        fnmatch(inner.name, pattern) or fnmatch(inner.as_posix(), pattern) for pattern in patterns
    )


@dataclass(frozen=True)
class FoundScan:
    """A scan, and the folder that it was found in, relative to the one that was searched."""

    scan: Path
    folder: PurePosixPath = field(default_factory=PurePosixPath)

    @property
    def stem(self) -> str:
        """The file's name without the extension that says how it is read, and without ``.gz``."""
        name = self.scan.name[:-3] if self.scan.suffix.lower() == ".gz" else self.scan.name
        return name[: len(name) - len(extension_of(self.scan))] or name


def output_names(scans: Sequence[FoundScan], template: str | None) -> list[str]:
    """Return the name of each scan's outputs: a path below the output folder, without an extension.

    Without a template it is the folder and the stem. Scans that would share a name keep their extensions in it.

    Raises
    ------
    UsageError
        When the template cannot be filled, leads out of the folder, or gives two scans one name.
    """
    if template is None:
        names = [fill_template("{folder}/{stem}", one, index) for index, one in enumerate(scans, 1)]
        count = Counter(name.casefold() for name in names)
        names = [
            fill_template("{folder}/{name}", one, index) if count[name.casefold()] > 1 else name
            for index, (one, name) in enumerate(zip(scans, names, strict=True), 1)
        ]
    else:
        names = [fill_template(template, one, index) for index, one in enumerate(scans, 1)]
    _require_distinct(scans, names)
    return names


def fill_template(template: str, found: FoundScan, index: int) -> str:
    """Return a template filled in for a scan, as a relative path with slashes.

    Fields are ``stem`` and ``name``, the file's name without and with its extension; ``folder``, where it was found,
    relative to the folder that was searched; ``parent``, the name of the folder that contains it; and ``index``, its
    number in the batch, from 1.

    Raises
    ------
    UsageError
        When the template has an unknown field, or the path would lead out of the folder.
    """
    values = {
        "stem": found.stem,
        "name": found.scan.name,
        "folder": str(found.folder),
        "parent": found.scan.absolute().parent.name,
        "index": index,
    }
    try:
        fields = [field for _, field, _, _ in string.Formatter().parse(template) if field is not None]
        text = template.format(**values) if set(fields) <= values.keys() else None
    except (ValueError, KeyError, IndexError):
        text = None
    if text is None:
        shown = ", ".join(f"{{{name}}}" for name in values)
        raise UsageError(f"{template!r} is not a template of names; the fields are {shown}.")
    path = PurePosixPath(text)
    if path.is_absolute() or ".." in path.parts or not path.name or path.parts[0].startswith(".gnrecon"):
        raise UsageError(
            f"The template {template!r} makes {text!r} of {found.scan}, which is not a name within the folder."
        )
    return str(path)


def _require_distinct(scans: Sequence[FoundScan], names: Sequence[str]) -> None:
    owners: dict[str, Path] = {}
    for one, name in zip(scans, names, strict=True):
        # Some file systems do not distinguish A from a.
        other = owners.setdefault(name.casefold(), one.scan)
        if other is not one.scan:
            raise UsageError(
                f"{other} and {one.scan} would both be called {name!r}; "
                "distinguish them with a template such as --name '{folder}/{name}'."
            )


def reference_of(found: FoundScan, index: int, request: Request) -> Path | None:
    """Return a scan's reference in the folder of references; None where it has none.

    The template names a file in that folder, with its extension, or without to take any. By default, the reference has
    the scan's stem, and lies in the same subfolder as the scan or in the folder itself.

    Raises
    ------
    InputError
        When there is no such folder.
    UsageError
        When the template is invalid.
    """
    if request.references is None:
        return None
    if not request.references.is_dir():
        raise InputError(f"There is no folder {request.references}.")
    templates = ("{folder}/{stem}", "{stem}") if request.reference_name is None else (request.reference_name,)
    for template in templates:
        path = request.references / fill_template(template, found, index)
        # The extension of a reference need not be that of the scan, so all readable ones are tried.
        candidates = [path, *(path.with_name(path.name + extension) for extension in readable())]
        reference = next((candidate for candidate in candidates if candidate.is_file()), None)
        if reference is not None:
            return reference
    return None
