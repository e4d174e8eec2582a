"""Requests that make no sense are refused before any work."""

from __future__ import annotations

from pathlib import Path

import pytest

from gnrecon.batch.request import Request
from gnrecon.runtime.errors import UsageError


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        ({"sources": ()}, "Name a folder, a pattern or scans"),
        ({"sources": ("-",)}, "does not read standard input"),
        ({"mesh_format": "fbx"}, "cannot be written as 'fbx'; use obj, ply"),
        ({"jobs": 0}, "jobs must be positive, not 0"),
        ({"retry": -1}, "must not be negative, not -1"),
    ],
)
def test_requests_that_make_no_sense(values: dict[str, object], sentence: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=sentence):
        Request(**{"sources": ("scans",), "output": tmp_path, **values})  # type: ignore[arg-type]
