"""Times and amounts of memory as people write them."""

from __future__ import annotations

import re

from gnrecon.runtime.errors import UsageError

SECONDS = {"": 1.0, "s": 1.0, "m": 60.0, "min": 60.0, "h": 3600.0, "d": 86400.0}
MEGABYTES = {"kb": 1e-3, "mb": 1.0, "gb": 1e3, "tb": 1e6, "kib": 2**10 / 1e6, "mib": 2**20 / 1e6, "gib": 2**30 / 1e6}

_QUANTITY = re.compile(r"\s*(\d+\.?\d*|\.\d+)\s*([a-z]*)\s*", re.IGNORECASE)


def parse_seconds(text: str) -> float:
    """Return a positive time in seconds, from text such as ``90``, ``30s``, ``10m`` or ``1.5h``.

    Raises
    ------
    UsageError
        When it is none.
    """
    return _parsed(text, SECONDS, "time such as 90, 30s, 10m or 2h")


def parse_megabytes(text: str) -> float:
    """Return a positive amount of memory in MB of 10^6 bytes, from text such as ``800MB`` or ``4GB``.

    Raises
    ------
    UsageError
        When it is none.
    """
    return _parsed(text, MEGABYTES, "amount of memory such as 800MB, 4GB or 2GiB")


def _parsed(text: str, units: dict[str, float], expected: str) -> float:
    match = _QUANTITY.fullmatch(text)
    unit = None if match is None else units.get(match[2].lower())
    if match is None or unit is None or float(match[1]) <= 0:
        raise UsageError(f"{text!r} is no {expected}.")
    return float(match[1]) * unit
