"""Plugins: file readers, file writers and residuals that other installed packages provide as entry points.

A package names an object in its metadata, in the group ``gnrecon.readers``, ``gnrecon.writers`` or
``gnrecon.residuals``. Listing plugins reads metadata only; a package's code is imported when one of its plugins is
loaded. Every look-up reads the installed packages each time: nothing is registered or cached.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Literal

from gnrecon.runtime.errors import GnreconError, UsageError
from gnrecon.runtime.interrupts import reraised

PluginKind = Literal["reader", "writer", "residual"]
"""What a plugin is; the group of its entry points is ``gnrecon.`` and the plural."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Plugin:
    """One entry point and its kind."""

    kind: PluginKind
    entry: EntryPoint

    def __str__(self) -> str:
        """Return its kind, its name and its package, for messages."""
        return f"the {self.kind} {self.entry.name!r} of {self.package}"

    @property
    def package(self) -> str:
        """Name and version of its package, or the entry point's object where the metadata is damaged."""
        with suppress(Exception):
            if self.entry.dist is not None:
                return f"the package {self.entry.dist.name} {self.entry.dist.version}"
        return self.entry.value

    def load(self) -> Any:
        """Import the package and return the object.

        Raises
        ------
        UsageError
            When it cannot be imported, or cannot be called.
        """
        try:
            found = self.entry.load()
        except MemoryError:
            raise
        except (Exception, SystemExit) as error:
            raise UsageError(f"{_capital(self)} cannot be loaded ({describe_error(error)}).") from error
        if not callable(found):
            raise UsageError(f"{_capital(self)} is {type(found).__name__!r}, which cannot be called.")
        _log.info("Loaded %s.", self)
        return found

    def guarded(self, kind: type[GnreconError]) -> AbstractContextManager[None]:
        """Guard a block that runs the package's code: turn its exceptions into one sentence.

        Raises
        ------
        GnreconError
            Of the given kind, when the block fails; see `gnrecon.runtime.plugins.guarded` for the exceptions.
        """
        return guarded(kind, lambda error: f"{self.subject} failed ({describe_error(error)}).")

    @property
    def subject(self) -> str:
        """Its description as the subject of a sentence."""
        # A message about a reader begins with the name of the file.
        return str(self) if self.kind == "reader" else _capital(self)


def installed(kind: PluginKind) -> list[Plugin]:
    """Return all installed plugins of a kind, sorted by name."""
    found = (Plugin(kind, entry) for entry in entry_points(group=f"gnrecon.{kind}s"))
    return sorted(found, key=lambda plugin: plugin.entry.name)


def find(kind: PluginKind, name: str) -> Plugin | None:
    """Return the installed plugin of a kind and a name, or None.

    Raises
    ------
    UsageError
        When several packages provide it.
    """
    found = [plugin for plugin in installed(kind) if plugin.entry.name == name]
    if len(found) > 1:
        raise UsageError(
            f"Several packages offer a {kind} {name!r}: {' and '.join(plugin.package for plugin in found)}; "
            f"uninstall all but one of them."
        )
    return found[0] if found else None


def _capital(plugin: Plugin) -> str:
    return str(plugin).replace("the", "The", 1)


@contextmanager
def guarded(kind: type[GnreconError], sentence: Callable[[BaseException], str]) -> Iterator[None]:
    """Run a block of third-party code, and turn its exceptions into one sentence.

    `GnreconError`, `MemoryError`, operating system errors with a number, and interrupts pass through unchanged, the
    last even where the code catches them.

    Parameters
    ----------
    kind : class of the exception that is raised instead
    sentence : returns the message, given the original exception; see `describe_error`

    Raises
    ------
    GnreconError
        Of the given kind, for any other exception.
    """
    try:
        with reraised():
            yield
    except (GnreconError, MemoryError):
        raise
    except BaseException as error:
        if not _is_own_failure(error):
            raise
        message = sentence(error)
        _log.info("%s", message, exc_info=True)
        raise kind(message) from error


def describe_error(error: BaseException, *, max_characters: int = 200) -> str:
    """Return an exception in one line: its type, and its message cut to `max_characters`, about two lines."""
    message = " ".join(str(error).split())[:max_characters]
    return f"{type(error).__name__}{': ' if message else ''}{message}"


def _is_own_failure(error: BaseException) -> bool:
    """Return whether the third-party code itself failed."""
    if isinstance(error, OSError):
        return error.errno is None
    # A panic in a Rust library is a `PanicException`, which is not an `Exception`.
    return isinstance(error, Exception | SystemExit) or type(error).__name__ == "PanicException"
