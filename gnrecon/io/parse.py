"""Numbers in text: decoding a file and turning its words into float64, exactly."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice
from pathlib import Path

import numpy as np

from gnrecon.geometry.arrays import Float, Values
from gnrecon.runtime.errors import InputError

_ROWS_AT_A_TIME = 100_000


def read_text(path: Path) -> str:
    """Return the file as text, without a byte-order mark.

    Raises
    ------
    InputError
        When the file holds zero bytes, so it is no text.
    """
    data = path.read_bytes()
    if b"\0" in data:
        raise InputError("expected text, but the file holds binary data.")
    # Only comments may hold other than ASCII letters, so a wrong guess of their encoding is harmless.
    return data.decode("utf-8-sig", errors="replace")


def numbers(words: Sequence[str]) -> Float:
    """Return the words as an array of shape (len(words),).

    Raises
    ------
    InputError
        At the first word that is no number.
    """
    try:
        return np.fromiter(map(float, words), np.float64, len(words))
    except ValueError:
        raise InputError(f"{_first_bad(words)!r} is not a number.") from None


def rows_of(lines: Sequence[str], what: str) -> Float:
    """Return the numbers of all lines, as an array of equally many columns, at least 3; `what` names the lines.

    Raises
    ------
    InputError
        When a word is no number, or lines differ in length or hold fewer than 3.
    """
    if not lines:
        return np.empty((0, 3))
    columns = len(lines[0].split())
    values = numbers(" ".join(lines).split())
    if columns < 3 or len(values) != columns * len(lines):
        raise InputError(f"{what} do not all hold the same number of coordinates, at least 3.")
    return values.reshape(-1, columns)


def _first_bad(words: Sequence[str]) -> str:
    for word in words:
        try:
            float(word)
        except ValueError:
            return word[:40]
    raise AssertionError("called for words of which one is no number")


def format_rows(template: str, rows: Values) -> list[str]:
    """Return text blocks in which `template`, such as ``"v %r %r %r\\n"``, is filled in once for each row.

    ``%r`` writes the shortest digits that read back as the same float64. One format operation covers a block of rows,
    which is several times faster than a loop over rows, and blocks keep the memory bounded.
    """
    blocks = []
    for start in range(0, len(rows), _ROWS_AT_A_TIME):
        block = rows[start : start + _ROWS_AT_A_TIME]
        blocks.append((template * len(block)) % tuple(block.ravel().tolist()))
    return blocks


def meaningful_lines(text: str, comment: str = "#") -> list[str]:
    """Return the lines that hold more than blanks and comments, with trailing comments cut off."""
    if comment in text:
        stripped = (line.partition(comment)[0].strip() for line in text.splitlines())
    else:
        stripped = (line.strip() for line in text.splitlines())
    return [line for line in stripped if line]


def head(text: str, lines: int) -> list[str]:
    """Return the first lines of a text without splitting the rest of it."""
    return list(islice((line for line in text[: 4096 * lines].splitlines()), lines))


# Files that another file names: they are read only where they lie in its folder or below, whatever the name says.


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
