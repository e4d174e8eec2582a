"""Atomic writing, and checks of input and output paths before any work is done.

`atomic_write` writes to a hidden temporary file in the target's own folder (so the last step never crosses file
systems), verifies it, flushes it to the disk, and only then renames it to the target. A process killed at any moment
leaves the target unchanged. Where overwriting is not allowed, the name is given by a hard link, which fails if another
process has created the target in the mean time, so no file is lost.
"""

from __future__ import annotations

import os
import secrets
import stat
import unicodedata
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from gnrecon.runtime.errors import GnreconError, InputError, OutputError, UsageError


@contextmanager
def atomic_write(
    path: str | Path, overwrite: bool = False, verify: Callable[[Path], object] | None = None
) -> Iterator[Path]:
    """Yield a temporary path with the target's suffix; rename it to the target if the block succeeds.

    Parameters
    ----------
    path : the target; where it is a symbolic link, the file that it points to
    overwrite : whether an existing file may be replaced
    verify : called with the temporary path before the renaming; if it raises, nothing is renamed

    Raises
    ------
    OutputError
        When the folder is missing or not writable, the target exists, or writing fails (a full disk).
    """
    target = Path(os.path.realpath(path))
    temporary = _temporary(target)
    with _output_errors(path):
        _check(target, path, overwrite)
    try:
        # Created exclusively: the user's umask applies, and no existing file can be hit.
        with _output_errors(path):
            os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
            yield temporary
            if verify is not None:
                verify(temporary)
            sync(temporary)
            _rename(temporary, target, overwrite)
            sync(target.parent)
    except OutputError as error:
        # A block that itself writes atomically names its own target, which the user does not know.
        raise OutputError(str(error).replace(str(temporary), str(path))) from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


@contextmanager
def _output_errors(path: str | Path) -> Iterator[None]:
    """Turn what the system says about writing a target into an `OutputError`."""
    try:
        yield
    except GnreconError:
        raise
    except OSError as error:
        # numpy says how much it wrote, and not why no more.
        reason = error.strerror or f"{error} (the disk may be full)"
        raise OutputError(f"{path} could not be written: {reason}.") from error


def printable(text: str) -> str:
    r"""Return a text that UTF-8 can hold: bytes of file names that are no UTF-8 are written as ``\udcff``."""
    return text.encode("utf-8", errors="backslashreplace").decode("utf-8")


def one_line(text: str) -> str:
    r"""Return a text for a terminal or a line of a file: control characters of file names are written as ``\x1b``."""
    return "".join(
        sign.encode("unicode_escape").decode("ascii") if unicodedata.category(sign) in ("Cc", "Cs") else sign
        for sign in text
    )


def write_text(path: str | Path, text: str, overwrite: bool = False) -> None:
    """Write a text file, UTF-8, atomically.

    Raises
    ------
    OutputError
        As `atomic_write` does.
    """
    with atomic_write(path, overwrite) as temporary:
        temporary.write_text(printable(text), encoding="utf-8", newline="\n")


def _temporary(target: Path, *, most_stem: int = 20, most_suffix: int = 8) -> Path:
    """Return a hidden name in the target's folder, with its suffix, by which formats are found.

    Its length is bounded, in characters: the target's name may be as long as the file system allows.
    """
    suffix = target.suffix if len(target.suffix) <= most_suffix else ""
    return target.with_name(f".{target.stem[:most_stem]}.{secrets.token_hex(6)}{suffix}")


def _check(target: Path, path: str | Path, overwrite: bool) -> None:
    """Raise early, with a message that says what to do, where writing cannot succeed."""
    if not target.parent.is_dir():
        raise OutputError(f"{path} cannot be written: the folder {target.parent} does not exist.")
    try:
        found = target.stat()
    except FileNotFoundError:
        found = None
    if found is not None and not stat.S_ISREG(found.st_mode):
        raise OutputError(f"{path} cannot be written: it exists and is not a regular file.")
    if found is not None and not overwrite:
        raise OutputError(f"{path} exists already; choose another name or allow overwriting (--overwrite).")


def require_writable(path: Path, overwrite: bool) -> None:
    """Refuse, before any work, a target that could not be written after it.

    Whether its folder takes files only the system knows, so an empty one is made there and removed.

    Raises
    ------
    OutputError
        When the folder is missing or takes no files, the name is too long or a link that leads to itself, or the target
        exists and is not a regular file or may not be overwritten.
    """
    with _output_errors(path):
        target = Path(os.path.realpath(path))
        _check(target, path, overwrite)
        trial = _temporary(target)
        os.close(os.open(trial, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
        trial.unlink()


def _rename(temporary: Path, target: Path, overwrite: bool) -> None:
    if overwrite:
        temporary.replace(target)
        return
    try:
        os.link(temporary, target)
    except FileExistsError:
        raise OutputError(
            f"{target} was created by another process in the mean time and was not overwritten."
        ) from None
    except OSError:
        # Some file systems (exFAT, network shares) have no hard links; then only a second check is possible.
        _check(target, target, overwrite)
        temporary.replace(target)


def sync(path: Path) -> None:
    """Flush a file's contents, or a folder's entries, to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def is_standard_input(path: Path) -> bool:
    """Return whether a path among the inputs stands for standard input: ``-``."""
    return path == Path("-")


def require_files(inputs: Sequence[Path], targets: Sequence[Path], overwrite: bool) -> None:
    """Check before any work that the inputs exist and the targets can and may be written.

    Raises
    ------
    UsageError
        When a target is an input or another target.
    InputError
        When an input is missing.
    OutputError
        As `require_writable` does.
    """
    for path in inputs:
        if not is_standard_input(path) and not os.path.exists(path):  # noqa: PTH110 - a name too long is no file
            raise InputError(f"There is no file {path}.")
    for index, target in enumerate(targets):
        if any(same_file(target, other) for other in [*inputs, *targets[:index]]):
            raise UsageError(f"{target} is named twice; an input or another output is never overwritten.")
        require_writable(target, overwrite)


def same_file(one: Path, other: Path) -> bool:
    """Return whether two paths lead to one file, by links of any kind, or will once it exists."""
    try:
        return one.samefile(other)
    except OSError:  # one does not exist, or its name cannot
        return os.path.realpath(one) == os.path.realpath(other)
