"""What the tests of the benchmarks share: measurements without a process of their own, which takes seconds to start."""

from __future__ import annotations

import os
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

from gnrecon.runtime.errors import GnreconError


@pytest.fixture
def measured_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let `run_isolated` call its function in this process; those of its limits keep the real one."""

    def run(function: str, arguments: Mapping[str, Any], folder: Path, **_: Any) -> dict[str, Any]:
        module, _, name = function.partition(":")
        folder.mkdir(parents=True)
        try:
            figures: dict[str, Any] = getattr(import_module(module), name)(**arguments)
        except GnreconError as error:
            return {"error": str(error)}
        return {"peak_memory_mb": 300.0, "libraries_memory_mb": 200.0} | figures

    # A trial keeps to its processors, this process to all of them.
    monkeypatch.setattr(os, "sched_setaffinity", lambda *_: None, raising=False)
    for user in ("accuracy.trial", "scaling"):
        monkeypatch.setattr(import_module(f"benchmarks.{user}"), "run_isolated", run)
