"""Chunks of rows, which bound the memory of temporary arrays."""

from __future__ import annotations


def slices(count: int, size: int = 1 << 18) -> list[slice]:
    """Return slices that cover `count` rows, at most `size` in each."""
    return [slice(start, min(start + size, count)) for start in range(0, count, size)]
