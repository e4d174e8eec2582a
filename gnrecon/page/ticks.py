"""Where the marks of an axis stand: at round numbers."""

from __future__ import annotations

import math
from itertools import pairwise

from gnrecon.page.numbers import MINUS


def linear(low: float, high: float, most: int = 5) -> list[float]:
    """Return at most `most` multiples of 1, 2 or 5 times a power of ten that lie between `low` and `high`."""
    rough = (high - low) / most
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(factor * power for factor in (1, 2, 5, 10, 20) if _count(low, high, factor * power) <= most)
    first = math.ceil(low / step - 1e-9)
    return [index * step for index in range(first, first + _count(low, high, step))]


def decades(low: float, high: float, most: int = 6) -> list[int]:
    """Return the powers of ten, at most `most` and evenly spaced, that lie between positive `low` and `high`."""
    first, last = math.ceil(math.log10(low) - 1e-9), math.floor(math.log10(high) + 1e-9)
    return list(range(first, last + 1, max(1, -(-(last - first + 1) // most))))


def labels(places: list[float]) -> list[str]:
    """Return the marks' numbers, all with the same decimals: those that their step needs."""
    step = min((after - before for before, after in pairwise(places)), default=0) or 1.0
    digits = max(0, -math.floor(math.log10(step) + 1e-9))
    if digits > 5 or max(map(abs, places), default=0) >= 1e6:
        return [f"{place:.1e}".replace("-", MINUS) for place in places]
    return [f"{place:,.{digits}f}".replace("-", MINUS) for place in places]


def _count(low: float, high: float, step: float) -> int:
    return math.floor(high / step + 1e-9) - math.ceil(low / step - 1e-9) + 1
