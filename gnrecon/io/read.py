"""Reads a file as a cloud, as a mesh, or as whichever it holds; every malformed file gives one `InputError`.

The source may be a file, a gzip-compressed file, or standard input. Readers seek, compare sizes and pass names to
libraries, so what is no plain file is copied into one first. Where the system allows, the copy has no name: it is read
by its number among the process's open files, and its space is free again as soon as the process has ended, also when it
was killed. Readers of plugins, which may want a name with an extension, get a link to it in a temporary folder.
"""

from __future__ import annotations

import gzip
import logging
import os
import shutil
import sys
import tempfile
import zlib
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import BinaryIO

import numpy as np

from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.io.contents import Contents
from gnrecon.io.format_registry import READERS, SIGNATURES, is_readable, readable, reader_of
from gnrecon.io.parse import OPEN_FILES
from gnrecon.runtime.errors import InputError, MemoryLimitError, UsageError
from gnrecon.runtime.files import is_standard_input

_log = logging.getLogger(__name__)


def read_cloud(path: str | Path, format: str | None = None) -> PointCloud:
    """Read the points of a cloud or the vertices of a mesh, in the file's own units, exactly.

    Normals are those of the file; a mesh without any gives the area-weighted normals of its faces (zero for a vertex
    that no face uses). Rows with NaN are kept.

    Parameters
    ----------
    path : file to read, compressed by gzip or not; ``-`` for standard input
    format : extension that says how to read it, such as ``"ply"``; by default the file's own

    Raises
    ------
    InputError
        When the file is missing, empty, malformed, or of an unsupported kind.
    UsageError
        When `format` is not supported, or standard input is read without one.
    """
    contents = read_contents(Path(path), format)
    with input_errors_for(Path(path)):
        return contents.cloud()


def read_mesh(path: str | Path) -> Mesh:
    """Read a mesh with exactly the stored vertices and triangles; polygons are cut into fans, and STL corners merged.

    Raises
    ------
    InputError
        As `read_cloud` does, and when the file holds no faces.
    """
    shape = read_any(path)[0]
    if not isinstance(shape, Mesh):
        raise InputError(f"{path}: expected a mesh, but the file holds {len(shape)} points and no faces.")
    return shape


def read_reference(path: str | Path) -> Mesh | PointCloud:
    """Read a mesh where the file has faces, else a cloud; the errors are those of `read_cloud`."""
    return read_any(path)[0]


def read_any(path: str | Path) -> tuple[Mesh | PointCloud, tuple[str, ...]]:
    """Read as `read_reference` does, and describe what else the file holds, which is not read."""
    contents = read_contents(Path(path), None)
    with input_errors_for(Path(path)):
        return contents.shape(), contents.unread


def read_contents(path: Path, format: str | None) -> Contents:
    """Read everything in a file; the arguments and errors are those of `read_cloud`."""
    with opened(path, format) as (file, extension):
        read = reader_of(extension)
        assert read is not None, "only what something reads is opened"
        contents = read(file)
        if not len(contents.points):
            raise InputError("the file holds no points.")
    _log.info("Read %d points and %d faces of %s.", len(contents.points), len(contents.faces), path)
    return contents


@contextmanager
def opened(path: Path, format: str | None) -> Iterator[tuple[Path, str]]:
    """Yield a plain file with the data, and the extension, with its dot, that says how it is read.

    The arguments are those of `read_cloud`, and so are the errors, into which every failure in the block is turned.
    """
    if format is None and is_standard_input(path):
        how = f"say with --format how to read it, as one of {_supported()}"
        raise UsageError(f"Standard input has no extension: {how}.")
    extension = extension_of(path) if format is None else f".{format.lower().lstrip('.')}"
    if format is not None and not is_readable(extension):
        raise UsageError(f"The format {format!r} is not supported; expected one of {_supported()}.")
    with input_errors_for(path), uncompressed_file(path, extension) as file:
        _check_file(file, extension)
        yield file, extension


def _supported() -> str:
    return ", ".join(suffix[1:] for suffix in readable())


@contextmanager
def input_errors_for(path: Path) -> Iterator[None]:
    """Turn every failure to read a file into an error of one sentence that begins with the file's name."""
    name = "standard input" if is_standard_input(path) else path
    try:
        # Damaged bytes are any numbers; those that cannot be computed with are dropped and counted later.
        with np.errstate(all="ignore"):
            yield
    except InputError as error:
        raise InputError(f"{name}: {error}") from None
    except MemoryLimitError:
        raise
    except MemoryError:
        raise MemoryLimitError(f"{name}: the file holds more than fits into this machine's memory.") from None
    except OSError as error:
        raise InputError(f"{name}: the file cannot be read: {error.strerror or error}.") from None
    except UsageError:
        raise
    # Damaged numbers can break a parser in ways that its checks do not cover; the user still gets one sentence.
    except (ValueError, ArithmeticError, LookupError, TypeError, RuntimeError, AttributeError, EOFError) as error:
        raise InputError(f"{name}: the file is malformed ({error}).") from None


def _check_file(path: Path, extension: str) -> None:
    """Refuse a path that is not a file, an empty file, or one that begins like a file of another kind."""
    if not path.exists():
        raise InputError("there is no such file.")
    if not path.is_file():
        raise InputError("expected a file, but this is a folder or a device.")
    with path.open("rb") as file:
        head = file.read(1 << 16)
    if not head.strip():
        raise InputError("the file is empty.")
    if not is_readable(extension):
        if extension == ".gnr":
            raise InputError("this is a fitted field, not a scan or a mesh: gnrecon mesh MODEL -o MESH meshes it.")
        known = f"expected one of {_supported()} (see --format)"
        raise InputError(f"the extension {extension!r} is not supported; {known}.")
    if extension not in READERS:
        return  # the signatures of plugin formats are unknown
    kind = next((kind for kind, signatures in SIGNATURES.items() if head.startswith(signatures)), extension)
    # LAS and LAZ have the same signature and reader; 3MF files are ZIP archives.
    if kind == extension or {kind, extension} in ({".las", ".laz"}, {"ZIP archive", ".3mf"}, {"ZIP archive", ".npz"}):
        return
    if kind in READERS:
        raise InputError(f"the file holds {kind[1:].upper()} data; rename it or give its format as {kind[1:]!r}.")
    raise InputError(f"expected {extension[1:].upper()} data, but the file is a {kind} file.")


def extension_of(path: Path) -> str:
    """Return the extension that says how a file is read, in lower case; ``.gz`` is skipped."""
    return Path(path.stem if path.suffix.lower() == ".gz" else path.name).suffix.lower()


@contextmanager
def uncompressed_file(path: Path, extension: str) -> Iterator[Path]:
    """Yield a plain file with the data to read: the file itself, or a temporary copy of compressed data or a stream.

    The extension, with its dot, says how it is to be read; a copy with a name has it. Damaged data, and more than a
    scan can hold or the disk takes, ends in an `InputError`, and a terminal as standard input in a `UsageError`.
    """
    if not is_standard_input(path) and not _is_compressed(path):
        yield path
        return
    with _temporary(f"stream{extension}", extension) as stream, _temporary(f"unpacked{extension}", extension) as target:
        source = path
        if is_standard_input(path):
            if sys.stdin.isatty():
                example = "gnrecon - --format xyz < scan.xyz"
                raise UsageError(f"Standard input is a terminal; send it a file, as in: {example}")
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
        if OPEN_FILES.is_dir():
            file = stack.enter_context(tempfile.TemporaryFile(prefix="gnrecon-"))
            if extension in READERS:
                yield OPEN_FILES / str(file.fileno())
                return
        named = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="gnrecon-"))) / name
        if OPEN_FILES.is_dir():
            named.symlink_to(f"/proc/{os.getpid()}/fd/{file.fileno()}")  # not /proc/self, for other processes
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
    """Copy a stream into a file, by chunks.

    Parameters
    ----------
    packed_bytes : size of the compressed data, None of other data
    most_disk_share : of the free space that the copy may take, so that other programs have some left
    most_ratio, least_suspect_bytes : larger copies of data that was compressed more than this are refused; gzip reaches
        1,000 with bytes that are all the same, and scans 3 to 20
    """
    folder = tempfile.gettempdir()
    most, copied = int(most_disk_share * shutil.disk_usage(folder).free), 0
    size = f"{most / 1e9:,.1f} GB" if most >= 1e8 else f"{most / 1e6:,.1f} MB"
    too_much = f"it takes more than {size}, {100 * most_disk_share:.0f} % of what is free in {folder}, where it is "
    done = "copied" if packed_bytes is None else "unpacked"
    with target.open("wb") as file:
        while chunk := source.read(chunk_bytes):
            copied += len(chunk)
            if copied > most:
                raise InputError(f"{done}, {too_much}{done}; TMPDIR names another folder.")
            if packed_bytes is not None and copied > max(least_suspect_bytes, most_ratio * packed_bytes):
                raise InputError(f"it unpacks to more than {most_ratio:.0f} times its size, as no scan does.")
            file.write(chunk)
