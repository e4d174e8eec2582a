"""Options from TOML files and from ``name=value`` words.

A configuration has options by the names of `gnrecon.option_table.OptionTable`, or as the command line spells them
(``edge_length`` or ``edge-length``); ``reference``, a file to measure the mesh against; and ``timeout`` and ``memory``,
limits for each scan of a batch, of which a single run takes the memory. Tables named ``[scans."PATTERN"]`` apply to
scans whose path ends with the pattern, such as ``[scans."left/*.ply"]``. What comes later wins:

1. the defaults,
2. the configuration,
3. its tables for the scan, in the order of the file,
4. the command line: options, and ``--set NAME=VALUE``; an option that is given in both ways is refused.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePath
from typing import Any, get_args, get_origin

import tomli_w

from gnrecon.option_table import option_rows
from gnrecon.runtime.errors import InputError, UsageError, suggestion
from gnrecon.runtime.files import one_line, printable
from gnrecon.runtime.typed_values import described, shown
from gnrecon.version import __version__


@dataclass(frozen=True)
class Settings:
    """Options for any scan, in layers.

    Parameters
    ----------
    general : options for all scans
    tables : pattern of paths, and options for the scans that match it
    given : options of the command line
    source : the configuration that was read, or None
    """

    general: Mapping[str, Any] = field(default_factory=dict)
    tables: tuple[tuple[str, Mapping[str, Any]], ...] = ()
    given: Mapping[str, Any] = field(default_factory=dict)
    source: Path | None = None

    def of(self, scan: Path) -> dict[str, Any]:
        """Return the values for a scan: options, and perhaps a reference and limits."""
        found = dict(self.general)
        for pattern, table in self.tables:
            if PurePath(scan).match(pattern):
                found |= table
        return {**found, **self.given}

    def for_single_run(self, scan: Path) -> tuple[dict[str, Any], Path | None]:
        """Return the options for a scan without the limits of a batch, and the reference, if any."""
        values = self.of(scan)
        reference = values.pop("reference", None)
        return {name: value for name, value in values.items() if name in option_rows()}, reference


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
        When the configuration is missing or is not TOML.
    UsageError
        When an option is unknown, has a value of a wrong type, or is given twice.
    """
    tree = {} if path is None else _read(path)
    where = "" if path is None else f"{path}: "
    tables = tree.pop("scans", {})
    if not isinstance(tables, dict) or not all(isinstance(table, dict) for table in tables.values()):
        raise UsageError(f'{where}options for certain scans go into tables such as [scans."left/*.ply"].')
    folder = Path() if path is None else path.parent
    general = _checked(tree, where, folder)
    for name in tables:
        _require_pattern(name, where)
    for_scans = tuple((name, _checked(table, f"{where}{name}: ", folder)) for name, table in tables.items())
    chosen = _checked(dict(map(_split, words)), "--set: ", Path())
    if twice := [name for name in chosen if name in given]:
        raise UsageError(f"The option {twice[0]} is given twice, by --set and by its own name.")
    return Settings(general, for_scans, {**chosen, **given}, path)


def settings_text(values: Mapping[str, Any], scan: Path) -> str:
    """Return a configuration with all options in effect, so that a run with it makes the same mesh.

    Parameters
    ----------
    values : every option, and perhaps ``reference``; None is left out, which has the same effect
    scan : whose options these are
    """
    plain = {name: _plain(value) for name, value in values.items() if value is not None}
    head = f"# All options in effect, for {one_line(scan.name)}, of gnrecon {__version__}.\n"
    return head + tomli_w.dumps(plain)


def _plain(value: Any) -> Any:
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    value = str(value.absolute()) if isinstance(value, Path) else value
    return printable(value) if isinstance(value, str) else value


def _read(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"The configuration {path} cannot be read: {error.strerror or error}.") from error
    except (ValueError, RecursionError) as error:  # of TOML, of UTF-8, or a number of thousands of digits
        raise InputError(f"The configuration {path} is not TOML: {str(error).partition(';')[0]}.") from error


def _require_pattern(pattern: str, where: str) -> None:
    try:
        PurePath("scan.ply").match(pattern)
    except ValueError:
        raise UsageError(f"{where}the table of scans {pattern!r} has no pattern that a path could match.") from None


def _split(word: str) -> tuple[str, Any]:
    name, sign, text = word.partition("=")
    if not sign:
        raise UsageError(f"--set expects NAME=VALUE, not {word!r}.")
    return name.strip(), text.strip()


def _checked(table: Mapping[str, Any], where: str, folder: Path) -> dict[str, Any]:
    """The values of a table by option name, each of the option's type; paths are relative to the folder."""
    known = (*option_rows(), "reference", "timeout", "memory")
    found: dict[str, Any] = {}
    for key, value in table.items():
        name = key.replace("-", "_")
        if name not in known:
            raise UsageError(f"{where}there is no option {key!r}{suggestion(name, known)}.")
        if name in found:
            raise UsageError(f"{where}{name} is there twice, with a hyphen and without.")
        if name in ("timeout", "memory", "reference"):
            text = value if isinstance(value, str) else shown(value)
            found[name] = folder / text if name == "reference" else text
        else:
            found[name] = typed(name, value, where)
    return found


def typed(name: str, value: Any, where: str = "") -> Any:
    """Return an option's value as one of the option's types.

    Text is read as a TOML value, unless the option takes text. Lists may also be written with commas.

    Parameters
    ----------
    name : of the option
    value : from TOML, or text
    where : start of an error's sentence

    Raises
    ------
    UsageError
        When the value has another type.
    """
    kinds = option_rows()[name].types
    for kind in kinds:
        found = _converted(kind, value)
        if found is not None:
            return found
    raise UsageError(f"{where}{name} must be {described(kinds)}, not {shown(value)}.")


def _converted(kind: Any, value: Any) -> Any:
    """The value as one of a type; None where it is not one."""
    if get_origin(kind) is tuple:
        return _converted_items(get_args(kind)[0], value)
    if kind is str:
        return value if isinstance(value, str) else None
    read = _read_value(value) if isinstance(value, str) else value
    if kind is float and isinstance(read, int | float) and not isinstance(read, bool):
        try:
            return float(read)
        except OverflowError:  # a whole number beyond the range of doubles
            return None
    return read if type(read) is kind else None


def _converted_items(kind: Any, value: Any) -> tuple[Any, ...] | None:
    if isinstance(value, str) and kind is str:
        return (value,)
    if isinstance(value, str):
        read = _read_value(value)
        value = read if isinstance(read, list) else [_read_value(part) for part in value.split(",")]
    items = [_converted(kind, item) for item in value] if isinstance(value, list) else [_converted(kind, value)]
    return None if any(item is None for item in items) else tuple(items)


def _read_value(text: str) -> Any:
    """The TOML value that a text stands for; the text itself where it stands for none."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except (ValueError, KeyError, RecursionError):  # no TOML, or a number of thousands of digits
        return text
