"""What other installed packages add: readers and writers of files, and residuals, by their entry points.

A package names an object of its own in its metadata, under one of the groups below. To list them, metadata alone is
read; a package's code is imported when one of its names is asked for, and not before. What is looked up is what is
installed at that moment: nothing is registered, and nothing is kept.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from gnrecon.runtime.errors import GnreconError, UsageError

READERS, WRITERS, RESIDUALS = "gnrecon.readers", "gnrecon.writers", "gnrecon.residuals"

KINDS = {READERS: "reader", WRITERS: "writer", RESIDUALS: "residual"}
"""Groups of entry points, and what each holds."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Plugin:
    """One entry point: its group, its name there, and where it comes from."""

    group: str
    entry: EntryPoint

    def __str__(self) -> str:
        """Say what it is and which package brings it."""
        return f"the {KINDS[self.group]} {self.entry.name!r} of {self.package}"

    @property
    def package(self) -> str:
        """The package that it comes from, or its object where the metadata is too damaged to say."""
        with suppress(Exception):
            if self.entry.dist is not None:
                return f"the package {self.entry.dist.name} {self.entry.dist.version}"
        return self.entry.value

    def load(self) -> Any:
        """Return the object, importing its package.

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
            raise UsageError(f"{_capital(self)} cannot be loaded ({told(error)}).") from error
        if not callable(found):
            raise UsageError(f"{_capital(self)} is {type(found).__name__!r}, which cannot be called.")
        _log.info("Loaded %s.", self)
        return found

    def guarded(self, kind: type[GnreconError]) -> AbstractContextManager[None]:
        """Guard a block of the package's own code; whatever goes wrong in it is one sentence.

        Raises
        ------
        GnreconError
            Of the given kind, when the block fails by its own fault; see `gnrecon.runtime.plugins.guarded`.
        """
        return guarded(kind, lambda error: f"{self.subject} failed ({told(error)}).")

    @property
    def subject(self) -> str:
        """What it is, as the subject of the sentence that says what it did."""
        # What is said of a reader follows the name of the file.
        return str(self) if self.group == READERS else _capital(self)


def installed(group: str) -> list[Plugin]:
    """Return all that installed packages offer of a group, by name."""
    return sorted((Plugin(group, entry) for entry in entry_points(group=group)), key=lambda one: one.entry.name)


def find(group: str, name: str) -> Plugin | None:
    """Return what is installed of a group under a name, or None.

    Raises
    ------
    UsageError
        When several packages offer it, so that chance would decide.
    """
    found = [one for one in installed(group) if one.entry.name == name]
    if len(found) > 1:
        raise UsageError(
            f"Several packages offer a {KINDS[group]} {name!r}: {' and '.join(one.package for one in found)}; "
            f"uninstall all but one of them."
        )
    return found[0] if found else None


def _capital(plugin: Plugin) -> str:
    return str(plugin).replace("the", "The", 1)


_LONGEST = 200


# Code of other people that runs on files: whatever it raises on damaged ones becomes one sentence.


@contextmanager
def guarded(kind: type[GnreconError], sentence: Callable[[BaseException], str]) -> Iterator[None]:
    """Run a block of other people's code.

    Failures of gnrecon's own kinds, want of memory, what the system says of a file, and interrupts come through as they
    are.

    Parameters
    ----------
    kind : of the failure that the block's own ones become
    sentence : says what failed, given what was raised; see `told`

    Raises
    ------
    GnreconError
        Of the given kind, when the block fails in any other way.
    """
    try:
        yield
    except (GnreconError, MemoryError):
        raise
    except BaseException as error:
        if not _fails(error):
            raise
        said = sentence(error)
        _log.info("%s", said, exc_info=True)
        raise kind(said) from error


def told(error: BaseException) -> str:
    """Return what was raised in one line: its type, and the beginning of what it says."""
    said = " ".join(str(error).split())[:_LONGEST]
    return f"{type(error).__name__}{': ' if said else ''}{said}"


def _fails(error: BaseException) -> bool:
    """Whether this is the code's own failure."""
    if isinstance(error, OSError):
        return error.errno is None
    # What goes wrong inside of a library written in Rust is a `PanicException`, which is no `Exception`.
    return isinstance(error, Exception | SystemExit) or type(error).__name__ == "PanicException"
