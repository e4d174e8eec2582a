"""Rows by stretches: what is computed of millions at a time takes little memory beside them."""

from __future__ import annotations


def slices(count: int, size: int = 1 << 18) -> list[slice]:
    """Return slices that cover `count` rows, at most `size` at a time."""
    return [slice(start, min(start + size, count)) for start in range(0, count, size)]
