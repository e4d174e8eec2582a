"""What a run says of itself: plain values, stages, and what the GPU took where there is one."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest
import torch
from held_memory import resident, use

from gnrecon.report.report import Stages, plain


def ignored(name: str) -> None:
    """Take no notice of a stage's name."""
    del name


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        ({"a": (1, 2.5, "x", None, True)}, {"a": [1, 2.5, "x", None, True]}),
        ([math.nan, {"gain": -math.inf}, (math.inf, 0.0)], [None, {"gain": None}, [None, 0.0]]),
        (np.float64("nan"), None),
    ],
)
def test_plain_values_are_json(value: Any, expected: Any) -> None:
    assert plain(value) == expected
    assert json.loads(json.dumps(plain(value), allow_nan=False)) == expected


def test_stages_are_announced_and_measured() -> None:
    told: list[str] = []
    resident()
    stages = Stages(told.append)
    with stages("read"):
        use(200)
    with stages("fit"):
        sum(range(200_000))
    first, second = stages.as_list()
    assert told == [first["name"], second["name"]] == ["read", "fit"]
    assert first["peak_memory_mb"] > second["peak_memory_mb"] + 100
    assert second["cpu_seconds"] > 0
    resources = stages.resources()
    assert resources["peak_memory_mb"] >= first["peak_memory_mb"]
    assert resources["seconds"] >= first["seconds"] + second["seconds"] - 0.002
    assert (resources["device_name"], resources["cuda_peak_memory_mb"]) == (None, None)


def test_a_stage_that_fails_is_not_recorded() -> None:
    stages = Stages(ignored)
    with pytest.raises(KeyError), stages("read"):
        raise KeyError
    assert stages.as_list() == []


def test_the_gpu_is_asked_for_the_peak_of_this_run(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[str, str]] = []
    answers = {"reset_peak_memory_stats": None, "max_memory_allocated": 2_500_000, "get_device_name": "A GPU"}
    for name, answer in answers.items():
        monkeypatch.setattr(torch.cuda, name, lambda device, n=name, a=answer: (asked.append((n, device)), a)[1])
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 0)
    stages = Stages(ignored, "cuda:1")
    assert asked == [("reset_peak_memory_stats", "cuda:1")]
    resources = stages.resources()
    assert (resources["cuda_peak_memory_mb"], resources["device_name"]) == (2.5, "A GPU")
    assert {device for _, device in asked} == {"cuda:1"}
