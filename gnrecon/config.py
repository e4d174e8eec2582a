"""Options from files and words: a configuration in TOML, tables in it for certain scans, and ``name=value`` words.

A configuration has options by the names of `gnrecon.options.Options`, or as the command line spells them
(``edge_length`` or ``edge-length``), ``reference``, a file to measure the mesh against, and ``timeout`` and ``memory``,
the limits that a batch sets to each scan; a single run has none. Tables named ``[scans."PATTERN"]`` hold for the scans
whose path ends so, as ``[scans."left/*.ply"]``. What comes later wins:

1. the defaults,
2. the configuration,
3. its tables for the scan, in the order of the file,
4. the command line: options, and ``--set NAME=VALUE``; an option that is given in both ways is refused.
"""

from __future__ import annotations

import tomllib
import types
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cache
from pathlib import Path, PurePath
from typing import Any, Union, get_args, get_origin, get_type_hints

import tomli_w

from gnrecon.options import Options
from gnrecon.runtime.errors import InputError, UsageError
from gnrecon.version import __version__

REFERENCE = "reference"

LIMITS = ("timeout", "memory")

_SCANS = "scans"

_KNOWN = (*(option.name for option in fields(Options)), REFERENCE, *LIMITS)


@dataclass(frozen=True)
class Settings:
    """Options for any scan, in layers.

    Parameters
    ----------
    general : of all scans
    tables : pattern of paths, and what holds for the scans that match it
    given : of the command line
    source : the configuration that was read, or None
    """

    general: Mapping[str, Any] = field(default_factory=dict)
    tables: tuple[tuple[str, Mapping[str, Any]], ...] = ()
    given: Mapping[str, Any] = field(default_factory=dict)
    source: Path | None = None

    def of(self, scan: Path) -> dict[str, Any]:
        """Return the values that hold for a scan: options, perhaps a reference, and limits."""
        found = dict(self.general)
        for pattern, table in self.tables:
            if PurePath(scan).match(pattern):
                found |= table
        return {**found, **self.given}


def read_settings(path: Path | None, words: Sequence[str], given: Mapping[str, Any]) -> Settings:
    """Return the settings of a command.

    Parameters
    ----------
    path : configuration, or None
    words : such as ``resolution=192``, with values as in TOML, or plain text
    given : options of the command line, by name

    Raises
    ------
    InputError
        When the configuration is missing or no TOML.
    UsageError
        When an option is unknown, has a value of a wrong type, or is given twice.
    """
    tree = {} if path is None else _read(path)
    where = "" if path is None else f"{path}: "
    tables = tree.pop(_SCANS, {})
    if not isinstance(tables, dict) or not all(isinstance(table, dict) for table in tables.values()):
        raise UsageError(f'{where}options for certain scans go into tables such as [scans."left/*.ply"].')
    folder = Path() if path is None else path.parent
    general = _checked(tree, where, folder)
    particular = tuple((name, _checked(table, f"{where}{name}: ", folder)) for name, table in tables.items())
    chosen = _checked(dict(map(_split, words)), "--set: ", Path())
    if twice := [name for name in chosen if name in given]:
        raise UsageError(f"The option {twice[0]} is given twice, by --set and by its own name.")
    return Settings(general, particular, {**chosen, **given}, path)


def settings_text(values: Mapping[str, Any], scan: Path) -> str:
    """Return a configuration that holds all options in effect, so that a run with it makes the same mesh.

    Parameters
    ----------
    values : every option, and perhaps ``reference``; an option without a value is left out, which means the same
    scan : that it belongs to
    """
    plain = {name: _plain(value) for name, value in values.items() if value is not None}
    head = f"# All options in effect, for {scan.name}, of gnrecon {__version__}.\n"
    return head + tomli_w.dumps(plain)


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else str(value.absolute()) if isinstance(value, Path) else value


def _read(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"The configuration {path} cannot be read: {error.strerror or error}.") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"The configuration {path} is no TOML: {error}.") from error


def _split(word: str) -> tuple[str, Any]:
    name, sign, text = word.partition("=")
    if not sign:
        raise UsageError(f"--set expects NAME=VALUE, not {word!r}.")
    return name.strip(), text.strip()


def _checked(table: Mapping[str, Any], where: str, folder: Path) -> dict[str, Any]:
    """The values of a table by the options' own names, each of its type."""
    found: dict[str, Any] = {}
    for key, value in table.items():
        name = key.replace("-", "_")
        if name not in _KNOWN:
            raise UsageError(f"{where}there is no option {key!r}; the options are {', '.join(_KNOWN)}.")
        if name in found:
            raise UsageError(f"{where}{name} is there twice, with a hyphen and without.")
        found[name] = _valued(name, value, where, folder)
    return found


def _valued(name: str, value: Any, where: str, folder: Path) -> Any:
    if name in LIMITS:
        return str(value)
    return folder / str(value) if name == REFERENCE else typed(name, value, where)


_WORDS = {
    bool: "true or false",
    int: "a whole number",
    float: "a number",
    str: "text",
}


# Values of options, of the type that the option has, from what TOML or a word of the command line says.


def typed(name: str, value: Any, where: str = "") -> Any:
    """Return an option's value, of a type that `Options` declares for it.

    Text is taken for what TOML would read from it, where text itself is none of the types; lists of whole numbers and
    of texts may be written with commas.

    Parameters
    ----------
    name : of the option
    value : as TOML has it, or text
    where : said before the sentence of an error

    Raises
    ------
    UsageError
        When the value is of another type.
    """
    kinds = _kinds(name)
    for kind in kinds:
        found = _as(kind, value)
        if found is not None:
            return found
    expected = " or ".join(dict.fromkeys(_words(kind) for kind in kinds))
    raise UsageError(f"{where}{name} must be {expected}, not {value!r}.")


@cache
def _kinds(name: str) -> tuple[Any, ...]:
    """The types of an option beside None, numbers first, so that text is tried last."""
    hint = get_type_hints(Options)[name]
    kinds = get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)
    return tuple(sorted((kind for kind in kinds if kind is not type(None)), key=lambda kind: kind is str))


def _as(kind: Any, value: Any) -> Any:
    """The value as one of a type; None where it is none."""
    if get_origin(kind) is tuple:
        return _items(get_args(kind)[0], value)
    if kind is str:
        return value if isinstance(value, str) else None
    read = _read_value(value) if isinstance(value, str) else value
    if kind is float and isinstance(read, int | float) and not isinstance(read, bool):
        return float(read)
    return read if type(read) is kind else None


def _items(kind: Any, value: Any) -> tuple[Any, ...] | None:
    if isinstance(value, str) and kind is str:
        return (value,)
    if isinstance(value, str):
        read = _read_value(value)
        value = read if isinstance(read, list) else [_read_value(part) for part in value.split(",")]
    items = [_as(kind, item) for item in value] if isinstance(value, list) else [_as(kind, value)]
    return None if any(item is None for item in items) else tuple(items)


def _read_value(text: str) -> Any:
    """What TOML reads from text; the text itself where that is nothing."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except (tomllib.TOMLDecodeError, KeyError):
        return text


def _words(kind: Any) -> str:
    if get_origin(kind) is tuple:
        return f"a list of which each is {_WORDS[get_args(kind)[0]]}"
    return _WORDS[kind]
