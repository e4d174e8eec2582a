"""Where a scan's bytes come from: a file, a gzip-compressed one, or standard input, always as a file to be read.

Readers seek, compare sizes and hand names to libraries, so what is no plain file is first copied into a temporary one.
"""

from __future__ import annotations

import gzip
import shutil
import sys
import tempfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gnrecon.runtime.errors import InputError, UsageError
from gnrecon.runtime.files import STANDARD_INPUT

_GZIP = b"\x1f\x8b"
_SUFFIX = ".gz"


def extension_of(path: Path) -> str:
    """Return the extension that says how a file is read: the one before ``.gz`` where it ends so; in lower case."""
    return Path(path.stem if path.suffix.lower() == _SUFFIX else path.name).suffix.lower()


@contextmanager
def plain_file(path: Path, extension: str) -> Iterator[Path]:
    """Yield a file that holds what is to be read, neither compressed nor a stream.

    Parameters
    ----------
    path : file to read; ``-`` for standard input
    extension : how it is to be read, with the dot; a copy has it

    Raises
    ------
    InputError
        When compressed data is damaged.
    UsageError
        When standard input is a terminal, where nobody would be waiting for points to be typed.
    """
    if path != STANDARD_INPUT and not _is_compressed(path):
        yield path
        return
    with tempfile.TemporaryDirectory(prefix="gnrecon-") as folder:
        source = _from_standard_input(Path(folder) / f"stream{extension}") if path == STANDARD_INPUT else path
        yield _unpacked(source, Path(folder) / f"unpacked{extension}") if _is_compressed(source) else source


def _is_compressed(path: Path) -> bool:
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(2) == _GZIP


def _from_standard_input(copy: Path) -> Path:
    if sys.stdin.isatty():
        raise UsageError("Standard input is a terminal; send it a file, as in: gnrecon - --format xyz < scan.xyz")
    with copy.open("wb") as file:
        shutil.copyfileobj(sys.stdin.buffer, file)
    return copy


def _unpacked(packed: Path, target: Path) -> Path:
    try:
        with gzip.open(packed) as source, target.open("wb") as file:
            shutil.copyfileobj(source, file)
    except (gzip.BadGzipFile, EOFError, zlib.error) as error:
        raise InputError(f"the compressed data is damaged ({error}).") from None
    return target
