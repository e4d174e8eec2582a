"""Parses and formats numbers in text files, exactly, and resolves names of files within a file.

What is not as it should be ends in an `InputError` of one sentence.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gnrecon.geometry.arrays import Float, Values
from gnrecon.io.io_parameters import IOParameters
from gnrecon.runtime.errors import InputError

OPEN_FILES = Path("/proc/self/fd")
"""The files that this process has open, by number, on Linux: where files without a name are read."""


def read_text(path: Path) -> str:
    """Return the file as text, without a byte-order mark; zero bytes are refused."""
    data = path.read_bytes()
    if b"\0" in data:
        raise InputError("expected text, but the file holds binary data.")
    # Only comments may hold other than ASCII characters, so a wrong guess of the encoding is harmless.
    return data.decode("utf-8-sig", errors="replace")


def parse_numbers(words: Sequence[str]) -> Float:
    """Return the words as an array of shape (len(words),)."""
    try:
        return np.fromiter(map(float, words), np.float64, len(words))
    except ValueError as error:
        word = str(error).partition(": ")[2].strip("'")
        raise InputError(f"{word[:40]!r} is not a number.") from None


def parse_rows(lines: Sequence[str], what: str) -> Float:
    """Return the numbers of all lines, equally many of at least 3 in each; `what` names the lines in messages."""
    if not lines:
        return np.empty((0, 3))
    columns = len(lines[0].split())
    values = parse_numbers(" ".join(lines).split())
    if columns < 3 or len(values) != columns * len(lines):
        raise InputError(f"{what} do not all hold the same number of coordinates, at least 3.")
    return values.reshape(-1, columns)


def format_rows(template: str, rows: Values, *, block_rows: int = 100_000) -> list[str]:
    """Return text blocks in which `template`, such as ``"v %r %r %r\\n"``, is filled in once for each row.

    ``%r`` writes the shortest digits that read back as the same float64. One format operation covers `block_rows` rows,
    which is several times faster than a loop over rows, and blocks keep the memory bounded.
    """
    blocks = (rows[start : start + block_rows] for start in range(0, len(rows), block_rows))
    return [(template * len(block)) % tuple(block.ravel().tolist()) for block in blocks]


def sibling_path(folder: Path, name: str, what: str) -> Path:
    """Return the path of a file named by another in `folder`; `what` describes it in messages.

    A file outside of the folder is never read, whatever the name says, nor any next to a copy of compressed data.
    """
    if folder == OPEN_FILES:
        raise InputError(f"the {what} {name[:80]!r} lies next to it, where compressed files have none; unpack it.")
    target = folder / name
    if not target.resolve().is_relative_to(folder.resolve()):
        raise InputError(f"the {what} {name[:80]!r} lies outside of the file's folder, so it is not read.")
    return target


def require_buildable(instances: int, numbers: int, stored: int, most_instances: int) -> None:
    """Refuse a scene that uses what it stores so often that it takes minutes or all memory to build.

    It builds so many instances of objects, of which `most_instances` take a minute, with so many coordinates, indices
    and attributes' values, of which the file itself can hold `stored`.
    """
    if instances > most_instances or numbers > max(IOParameters.most_built_numbers, stored):
        raise InputError(f"the scene builds {instances:,} objects with {numbers:,} numbers, more than can be read.")
