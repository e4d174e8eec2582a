"""Values of options, of the type that the option has, from what TOML or a word of the command line says."""

from __future__ import annotations

import tomllib
import types
from functools import cache
from typing import Any, Union, get_args, get_origin, get_type_hints

from gnrecon.options import Options
from gnrecon.runtime.errors import UsageError

_WORDS = {
    bool: "true or false",
    int: "a whole number",
    float: "a number",
    str: "text",
}


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
    read = _read(value) if isinstance(value, str) else value
    if kind is float and isinstance(read, int | float) and not isinstance(read, bool):
        return float(read)
    return read if type(read) is kind else None


def _items(kind: Any, value: Any) -> tuple[Any, ...] | None:
    if isinstance(value, str) and kind is str:
        return (value,)
    if isinstance(value, str):
        read = _read(value)
        value = read if isinstance(read, list) else [_read(part) for part in value.split(",")]
    items = [_as(kind, item) for item in value] if isinstance(value, list) else [_as(kind, value)]
    return None if any(item is None for item in items) else tuple(items)


def _read(text: str) -> Any:
    """What TOML reads from text; the text itself where that is nothing."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except (tomllib.TOMLDecodeError, KeyError):
        return text


def _words(kind: Any) -> str:
    if get_origin(kind) is tuple:
        return f"a list of which each is {_WORDS[get_args(kind)[0]]}"
    return _WORDS[kind]
