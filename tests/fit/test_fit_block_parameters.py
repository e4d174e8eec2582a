"""Parameters of fits by blocks: frozen, all of them used, and decisive."""

from __future__ import annotations

import ast
from dataclasses import FrozenInstanceError, fields
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import psutil
import pytest

import gnrecon
from gnrecon.field.partition_of_unity import Partition
from gnrecon.fit.blocks import solve, workers
from gnrecon.fit.blocks.block_parameters import BlockParameters

DEFAULT = BlockParameters()


def test_they_are_frozen() -> None:
    with pytest.raises(FrozenInstanceError):
        DEFAULT.block_points = 1  # type: ignore[misc]


def test_each_is_used() -> None:
    sources = Path(gnrecon.__file__).parent.rglob("*.py")
    nodes = [node for path in sources for node in ast.walk(ast.parse(path.read_text()))]
    used = {node.attr for node in nodes if isinstance(node, ast.Attribute) and "BlockParameters" in ast.unparse(node)}
    assert {field.name for field in fields(DEFAULT)} <= used


def test_processes_fit_into_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    free = SimpleNamespace(available=10.5 * DEFAULT.worker_bytes)
    monkeypatch.setattr(psutil, "virtual_memory", lambda: free)
    assert workers._affordable_processes() == 10
    assert workers._affordable_processes(worker_bytes=3 * DEFAULT.worker_bytes) == 3
    assert workers._affordable_processes(worker_bytes=20 * DEFAULT.worker_bytes) == 1


def test_how_many_points_are_looked_up_at_a_time_does_not_matter() -> None:
    points = np.random.default_rng(0).uniform(-1, 1, (500, 3))
    partition = Partition(points.min(axis=0), 0.4)
    np.testing.assert_array_equal(
        solve._occupied_cubes(partition, points), solve._occupied_cubes(partition, points, lookup_points=7)
    )
