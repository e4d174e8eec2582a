"""Slices of rows."""

from __future__ import annotations

import pytest

from gnrecon.runtime.chunks import slices


@pytest.mark.parametrize(("count", "size"), [(0, 5), (1, 5), (5, 5), (6, 5), (23, 7)])
def test_every_row_is_covered_once(count: int, size: int) -> None:
    found = slices(count, size)
    assert [row for part in found for row in range(count)[part]] == list(range(count))
    assert all(part.stop - part.start <= size for part in found)
