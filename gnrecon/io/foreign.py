"""Guarding a call into a library that parses files: whatever it raises on damaged ones becomes one sentence."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from gnrecon.errors import GnreconError, InputError


@contextmanager
def parsing(kind: str) -> Iterator[None]:
    """Run a block that parses a file of a kind, such as ``"LAS"``.

    Raises
    ------
    InputError
        When the library in the block fails in whichever way. Want of memory, and what the system says of the file, come
        through as they are.
    """
    try:
        yield
    except (GnreconError, MemoryError):
        raise
    except OSError as error:
        if error.errno is not None:
            raise
        raise InputError(_sentence(kind, error)) from None
    except Exception as error:
        raise InputError(_sentence(kind, error)) from None
    except BaseException as error:
        # What goes wrong inside of a library written in Rust surfaces so, and is no `Exception`.
        if type(error).__name__ != "PanicException":
            raise
        raise InputError(_sentence(kind, error)) from None


def _sentence(kind: str, error: BaseException) -> str:
    said = " ".join(str(error).split())[:200]
    return f"the file is not a well-formed {kind} file ({type(error).__name__}{': ' if said else ''}{said})."
