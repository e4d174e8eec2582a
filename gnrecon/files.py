"""Which files a command may read and write, decided before any work: what would fail after it is refused."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from gnrecon.errors import InputError, OutputError, UsageError

STANDARD_INPUT = Path("-")
"""How standard input is named among the inputs."""


def require_files(inputs: Sequence[Path], targets: Sequence[Path], overwrite: bool) -> None:
    """Refuse missing inputs, and targets that could not or must not be written.

    Raises
    ------
    UsageError
        When a target is an input or another target.
    InputError
        When an input is missing.
    OutputError
        When a target exists and may not be overwritten, or its folder is missing.
    """
    for path in inputs:
        if path != STANDARD_INPUT and not path.exists():
            raise InputError(f"There is no file {path}.")
    for index, target in enumerate(targets):
        if any(_same(target, other) for other in [*inputs, *targets[:index]]):
            raise UsageError(f"{target} is named twice; an input or another output is never overwritten.")
        if not target.parent.is_dir():
            raise OutputError(f"{target} cannot be written: the folder {target.parent} does not exist.")
        if target.exists() and not overwrite:
            raise OutputError(f"{target} exists already; choose another name or add --overwrite.")


def _same(one: Path, other: Path) -> bool:
    if one.exists() and other.exists():
        return one.samefile(other)
    return one.resolve() == other.resolve()
