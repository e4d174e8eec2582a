"""Checks that the values of options have the types that their dataclass states, and reads times and sizes from text.

Only the standard library is imported here, because the command line reads its table of options whenever it starts.
"""

from __future__ import annotations

import operator
import os
import re
import types
from collections.abc import Mapping
from dataclasses import fields
from functools import cache
from numbers import Real
from typing import Any, Union, get_args, get_origin, get_type_hints

from gnrecon.runtime.errors import UsageError


def require_field_types(record: Any) -> None:
    """Check the fields of a dataclass, and replace numbers of numpy and paths by plain numbers and texts.

    Raises
    ------
    UsageError
        When a value has another type than its field; the sentence names the field and the value.
    """
    types_of = _field_types(record.__class__)
    for option in fields(record):
        value, (kinds, optional) = getattr(record, option.name), types_of[option.name]
        if value is None and optional:
            continue
        found = next((plain for kind in kinds if (plain := _plain(kind, value)) is not None), None)
        if found is None:
            raise UsageError(f"{option.name} must be {described(kinds)}, not {shown(value)}.")
        object.__setattr__(record, option.name, found)


def shown(value: object, *, most_characters: int = 60) -> str:
    """Return a value as a message shows it: short and in one line, or else by its type."""
    try:
        text = repr(value)
    except ValueError:  # Python prints no whole number of thousands of digits
        text = ""
    return text if 0 < len(text) <= most_characters and "\n" not in text else f"a value of type {type(value).__name__}"


def require_at_most(record: object, limits: Mapping[str, int]) -> None:
    """Refuse fields of a record that exceed their limits; None exceeds none.

    Raises
    ------
    UsageError
        Naming the field.
    """
    for name, limit in limits.items():
        if (value := getattr(record, name)) is not None and value > limit:
            raise UsageError(f"{name} must be at most {limit:,}, not {shortened(value)}.")


def most_threads(*, least: int = 256) -> int:
    """Return a limit for threads: `least`, or the processors, where there are more. Thousands end the process."""
    return max(least, os.cpu_count() or 1)


def shortened(value: float, *, most_digits: int = 30) -> str:
    """Return a number as text; one of more digits than anybody reads, by their number."""
    # Python refuses to print whole numbers of thousands of digits.
    large = isinstance(value, int) and abs(value) >= 10**most_digits
    return f"a number of more than {most_digits} digits" if large else f"{value}"


@cache
def _field_types(record: Any) -> dict[str, tuple[tuple[Any, ...], bool]]:
    """The types of each field besides None, and whether it may be None."""
    return {name: (value_types(hint), type(None) in get_args(hint)) for name, hint in get_type_hints(record).items()}


def value_types(hint: Any) -> tuple[Any, ...]:
    """Return the types of a hint besides None, numbers first: any text would pass for text."""
    kinds = get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)
    return tuple(sorted((kind for kind in kinds if kind is not type(None)), key=lambda kind: kind is str))


def described(kinds: tuple[Any, ...]) -> str:
    """Return types in words, for the message on a value of another type."""
    return " or ".join(dict.fromkeys(map(_described, kinds)))


def _described(kind: Any) -> str:
    if get_origin(kind) is tuple:
        return "a list of texts" if get_args(kind)[0] is str else "a list of whole numbers such as 2000 or 32,32,32"
    return {bool: "true or false", int: "a whole number", float: "a number", str: "text"}[kind]


def _plain(kind: Any, value: Any) -> Any:
    """The value as a plain one of a type; None where it has another type."""
    if get_origin(kind) is tuple:
        if (
            isinstance(value, str | bytes | dict | set)
            or not hasattr(value, "__iter__")
            or not hasattr(value, "__len__")
        ):
            return None
        items = [_plain(get_args(kind)[0], item) for item in value]
        return None if any(item is None for item in items) else tuple(items)
    truth = isinstance(value, bool) or getattr(getattr(value, "dtype", None), "kind", "") == "b"
    if kind is bool or truth:
        return bool(value) if kind is bool and truth and not getattr(value, "ndim", 0) else None
    if kind is int:
        return operator.index(value) if hasattr(value, "__index__") and not getattr(value, "ndim", 0) else None
    if kind is float:
        # A whole number stays as the caller wrote it.
        return value if type(value) is int else float(value) if isinstance(value, Real) else None
    return os.fspath(value) if isinstance(value, str | os.PathLike) else None


def parse_seconds(text: str) -> float:
    """Return a positive time in seconds, from text such as ``90``, ``30s``, ``10m`` or ``1.5h``.

    Raises
    ------
    UsageError
        When the text is not such a time.
    """
    units = {"": 1.0, "s": 1.0, "m": 60.0, "min": 60.0, "h": 3600.0, "d": 86400.0}
    return _quantity(text, units, "a time such as 90, 30s, 10m or 2h")


def parse_megabytes(text: str) -> float:
    """Return a positive amount of memory in MB of 10^6 bytes, from text such as ``800MB`` or ``4GB``.

    Raises
    ------
    UsageError
        When the text is not such an amount.
    """
    units = {"kb": 1e-3, "mb": 1.0, "gb": 1e3, "tb": 1e6, "kib": 2**10 / 1e6, "mib": 2**20 / 1e6, "gib": 2**30 / 1e6}
    return _quantity(text, units, "an amount of memory such as 800MB, 4GB or 2GiB")


def _quantity(text: str, units: Mapping[str, float], expected: str) -> float:
    match = re.fullmatch(r"\s*(\d+\.?\d*|\.\d+)\s*([a-z]*)\s*", text, re.IGNORECASE)
    unit = None if match is None else units.get(match[2].lower())
    if match is None or unit is None or float(match[1]) <= 0:
        raise UsageError(f"{text!r} is not {expected}.")
    return float(match[1]) * unit
