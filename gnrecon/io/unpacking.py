"""Plain files of compressed scans and of streams, which vanish with the process whatever ends it.

Readers seek, compare sizes and pass names to libraries, so what is no plain file is copied into one first. Where the
system allows, the copy has no name: it is read by its number among the process's open files, and its space is free
again as soon as the process has ended, also when it was killed. Readers of plugins, which may want a name with an
extension, get a link to it in a temporary folder.
"""

from __future__ import annotations

import gzip
import os
import shutil
import sys
import tempfile
import zlib
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import BinaryIO

from gnrecon.io.format_registry import READERS
from gnrecon.io.parse import OPEN_FILES
from gnrecon.runtime.errors import InputError, UsageError
from gnrecon.runtime.files import is_standard_input


@contextmanager
def uncompressed_file(path: Path, extension: str) -> Iterator[Path]:
    """Yield a plain file with the data to read: the file itself, or a temporary copy of compressed data or a stream.

    Parameters
    ----------
    path : file to read; ``-`` for standard input
    extension : how it is to be read, with the dot; a copy with a name has this extension

    Raises
    ------
    InputError
        When compressed data is damaged, or there is more than a scan can hold or the disk takes.
    UsageError
        When standard input is a terminal, so that no file is sent.
    """
    if not is_standard_input(path) and not _is_compressed(path):
        yield path
        return
    with _temporary(f"stream{extension}", extension) as stream, _temporary(f"unpacked{extension}", extension) as target:
        source = path
        if is_standard_input(path):
            if sys.stdin.isatty():
                raise UsageError(
                    "Standard input is a terminal; send it a file, as in: gnrecon - --format xyz < scan.xyz"
                )
            _copy(sys.stdin.buffer, stream, None)
            source = stream
        if not _is_compressed(source):
            yield source
            return
        try:
            with gzip.open(source) as unpacking:
                _copy(unpacking, target, source.stat().st_size)
        except (gzip.BadGzipFile, EOFError, zlib.error) as error:
            raise InputError(f"the compressed data is damaged ({error}).") from None
        yield target


@contextmanager
def _temporary(name: str, extension: str) -> Iterator[Path]:
    """Yield the path of an empty temporary file, without a name where that is possible."""
    with ExitStack() as stack:
        if extension not in READERS or not OPEN_FILES.is_dir():
            named = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="gnrecon-"))) / name
        if not OPEN_FILES.is_dir():
            yield named
            return
        file = stack.enter_context(tempfile.TemporaryFile(prefix="gnrecon-"))
        if extension in READERS:
            yield OPEN_FILES / str(file.fileno())
            return
        # A reader may give the name to another process.
        named.symlink_to(f"/proc/{os.getpid()}/fd/{file.fileno()}")
        yield named


def _is_compressed(path: Path) -> bool:
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(2) == b"\x1f\x8b"  # the magic number of gzip


def _copy(
    source: BinaryIO | gzip.GzipFile,
    target: Path,
    packed_bytes: int | None,
    *,
    most_disk_share: float = 0.9,
    most_ratio: float = 200.0,
    least_suspect_bytes: int = 100_000_000,
    chunk_bytes: int = 1 << 20,
) -> None:
    """Copy a stream into a file.

    Parameters
    ----------
    source, target : stream and file
    packed_bytes : size of the compressed data, None of other data
    most_disk_share : of the free space that the copy may take, so that other programs have some left
    most_ratio, least_suspect_bytes : larger copies of data that was compressed more than this are refused; gzip reaches
        1,000 with bytes that are all the same, and scans 3 to 20
    chunk_bytes : copied at a time

    Raises
    ------
    InputError
        When there is more than that.
    """
    folder = tempfile.gettempdir()
    most, copied = int(most_disk_share * shutil.disk_usage(folder).free), 0
    too_much = f"it takes more than {most / 1e9:,.1f} GB, {100 * most_disk_share:.0f} % of what is free in {folder}, "
    with target.open("wb") as file:
        while chunk := source.read(chunk_bytes):
            copied += len(chunk)
            if copied > most:
                raise InputError(f"unpacked, {too_much}where it is unpacked; TMPDIR names another folder.")
            if packed_bytes is not None and copied > max(least_suspect_bytes, most_ratio * packed_bytes):
                raise InputError(f"it unpacks to more than {most_ratio:.0f} times its size, as no scan does.")
            file.write(chunk)
