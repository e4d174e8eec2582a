"""What the outputs of a scan are called, by a template, and what its reference is called."""

from __future__ import annotations

import string
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

from gnrecon.io import extension_of
from gnrecon.runtime.errors import UsageError

FIELDS = ("stem", "name", "folder", "parent", "index")
"""What a template may name: the file's name without and with its extension, its folder below the one that was given,
the name of the folder that it lies in, and its number in the batch, from 1."""


@dataclass(frozen=True)
class Found:
    """A scan, and the folder that it was found in, relative to the one that was asked for."""

    scan: Path
    folder: PurePosixPath = field(default_factory=PurePosixPath)

    @property
    def stem(self) -> str:
        """The file's name without the extension that says how it is read, and without ``.gz``."""
        name = self.scan.name[:-3] if self.scan.suffix.lower() == ".gz" else self.scan.name
        return name[: len(name) - len(extension_of(self.scan))] or name


def named(scans: Sequence[Found], template: str | None) -> list[str]:
    """Return the name of each scan's outputs: a path below the output folder, without an extension.

    Without a template it is the folder and the stem; scans that would share one are told apart by their extensions.

    Raises
    ------
    UsageError
        When the template cannot be filled, leads out of the folder, or gives two scans one name.
    """
    if template is None:
        names = [filled("{folder}/{stem}", one, index) for index, one in enumerate(scans, 1)]
        count = Counter(name.casefold() for name in names)
        names = [
            filled("{folder}/{name}", one, index) if count[name.casefold()] > 1 else name
            for index, (one, name) in enumerate(zip(scans, names, strict=True), 1)
        ]
    else:
        names = [filled(template, one, index) for index, one in enumerate(scans, 1)]
    _require_distinct(scans, names)
    return names


def filled(template: str, found: Found, index: int) -> str:
    """Return a template filled in for a scan, as a relative path with slashes.

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
        text = template.format(**values) if set(fields) <= set(FIELDS) else None
    except (ValueError, KeyError, IndexError):
        text = None
    if text is None:
        shown = ", ".join(f"{{{name}}}" for name in FIELDS)
        raise UsageError(f"{template!r} is no template of names; its fields are {shown}.")
    path = PurePosixPath(text)
    if path.is_absolute() or ".." in path.parts or not path.name or path.parts[0].startswith(".gnrecon"):
        raise UsageError(f"The template {template!r} makes {text!r} of {found.scan}, which is no name in the folder.")
    return str(path)


def _require_distinct(scans: Sequence[Found], names: Sequence[str]) -> None:
    owners: dict[str, Path] = {}
    for one, name in zip(scans, names, strict=True):
        # Some file systems hold A and a for the same.
        other = owners.setdefault(name.casefold(), one.scan)
        if other is not one.scan:
            raise UsageError(
                f"{other} and {one.scan} would both be called {name!r}; "
                "tell them apart by a template such as --name '{folder}/{name}'."
            )
