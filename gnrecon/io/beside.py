"""Files that another file names: they are read only where they lie in its folder or below, whatever the name says."""

from __future__ import annotations

from pathlib import Path

from gnrecon.runtime.errors import InputError


def beside(folder: Path, name: str, what: str) -> Path:
    """Return the path of a file that one in `folder` names; `what` says in words what it holds.

    Raises
    ------
    InputError
        When the name leads out of the folder.
    """
    target = folder / name
    if not target.resolve().is_relative_to(folder.resolve()):
        raise InputError(f"the {what} {name[:80]!r} lies outside of the file's folder, so it is not read.")
    return target
